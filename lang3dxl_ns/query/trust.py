"""Trust in answers: one word, and the reason behind it.

A right and a wrong answer look alike on the screen. Four measures tell them apart: doubt (`query/doubt.py`),
the peak that a prompt reaches, how far the scene is from what the CLIP was trained on, and whether another
word selects the same Gaussians. docs/queries.md has the figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.query.doubt import doubtful
from lang3dxl_ns.query.engine import QueryEngine
from lang3dxl_ns.query.vocabulary import same_thing
from lang3dxl_ns.scene.record import same_clip

Level = Literal["sure", "uncertain", "doubtful"]
ANCHORS = ("window", "door", "tower", "spire", "dome", "roof", "wall", "arch", "column")
"""Common words whose selections are compared with a prompt's."""
ALIKE = 0.85
"""Intersection over union from which two words select the same."""
FAINT = 0.5
"""Peaks below this are doubtful: a negative fits better than the prompt even at its best places."""
CLEARLY = 0.8
"""Peaks from which a prompt is found. `lang3dxl benchmark trust` on the six validation landmarks and castle,
with the level that the other scenes choose: none of 29 right words has a caution, and 281 of 281 wrong or
absent ones have one. The other thresholds were chosen on these scenes."""
STRICTER, STRICTEST = 0.15, 0.99
"""How much more a scene unlike what the CLIP was trained on has to reach, per unit of foreignness beyond
`FAR`, and the most that is asked for."""
FAR = 1.4
"""Foreignness from which a scene is unlike what the CLIP was trained on. Six validation landmarks have
0.9 to 1.2, the castle 2.0."""
KNOWN_WORLD = Path(__file__).parents[1] / "demo" / "known_world.safetensors"
"""Mean and inverse covariance of the built-in CLIP's features of landmarks that it was trained on."""
_TYPICAL = 5.3
"""Median distance of scenes of generated landmarks, so that their foreignness is about 1."""
_SAMPLE = 4096
_TEACH = "outline it in a photo (lang3dxl teach)"
_LARGER = "train with a larger CLIP, such as openai/clip-vit-base-patch32"


@dataclass(frozen=True)
class Trust:
    """How far to believe an answer."""

    level: Level
    reason: str
    """Sentence that says why."""
    remedy: str = ""
    """What helps; empty if the answer is sure."""
    alike: tuple[str, ...] = ()
    """Words that select the same Gaussians."""

    def __str__(self) -> str:
        return f"{self.level}: {self.reason}" + (f"; {self.remedy}" if self.remedy else "")


def judged(
    text: str,
    doubt: float,
    peak: float,
    *,
    taught: bool = False,
    foreign: float | None = None,
    alike: Sequence[str] = (),
    meant: str | None = None,
) -> Trust:
    """Judge an answer.

    Args:
        text: the prompt.
        doubt: share of unrelated words that fit as well.
        peak: mean relevancy of the prompt's best Gaussians, 0…1.
        taught: whether the prompt was taught by example.
        foreign: foreignness of the scene; None if it can't be measured.
        alike: words that select the same.
        meant: word of the scene that a misspelled prompt most likely means.
    """
    far = foreign is not None and foreign >= FAR
    remedy = f"{_TEACH}, or {_LARGER}" if far else _TEACH
    remedy = f"did you mean {meant}? If not, {remedy}" if meant else remedy
    if (why := doubtful(text, doubt, taught)) is not None:
        return Trust("doubtful", why.removeprefix("doubtful: "), "" if taught else remedy)
    if taught:
        return Trust("sure", f"{text!r} was taught by example")
    best = f"the best places for {text!r} fit at {peak:.2f}"
    if peak < FAINT:
        return Trust("doubtful", f"{best}, and other words fit better there: it may not be here", remedy)
    usual = "times as far from what its CLIP was trained on as usual"
    world = f"; this scene is {foreign:.1f} {usual}" if far else ""
    if peak < least_peak(foreign):
        return Trust("uncertain", f"{best}, where right words reach 1.00{world}", remedy)
    if alike:
        return Trust("uncertain", f"{text!r} selects the same as {' and '.join(alike)}", remedy, tuple(alike))
    return Trust("sure", f"{best}{world}")


def least_peak(foreign: float | None) -> float:
    """Compute the peak from which an answer is sure, by the foreignness of the scene."""
    if foreign is None or foreign < FAR:
        return CLEARLY
    return min(CLEARLY + STRICTER * (foreign - FAR), STRICTEST)


def alike(
    text: str, synonyms: Sequence[str], selected: Bool[Tensor, " n"], anchors: Bool[Tensor, "anchors n"]
) -> list[str]:
    """List the `ANCHORS` that select the same Gaussians as a prompt, but for words that mean the same."""
    common, either = (selected & anchors).sum(1), (selected | anchors).sum(1)
    same = (common >= ALIKE * either) & (common > 0)
    return [
        word for word, is_same in zip(ANCHORS, same.tolist(), strict=True)
        if is_same and not same_thing(word, [text, *synonyms])
    ]  # fmt: skip


def foreignness(engine: QueryEngine, clip_identity: str | None) -> float | None:
    """Measure how far a scene is from what its CLIP was trained on: the median Mahalanobis distance of the
    Gaussians' features, as a multiple of that of generated landmarks. None for a CLIP without statistics, and
    for a scene in which nothing is known."""
    known = engine.known.nonzero().squeeze(1)
    world = known_world(clip_identity)
    if world is None or not len(known):
        return None
    features = engine.features(known[:: max(len(known) // _SAMPLE, 1)]).float().cpu()
    off = features - world[0]
    return float(((off @ world[1]) * off).sum(1).clamp_min(0).sqrt().median()) / _TYPICAL


@cache
def known_world(clip_identity: str | None) -> tuple[Float[Tensor, " c"], Float[Tensor, "c c"]] | None:
    """Load the statistics of a CLIP; None if they are of another one."""
    from safetensors import safe_open

    with safe_open(KNOWN_WORLD, "pt") as file:
        if not same_clip(file.metadata()["clip"], clip_identity):
            return None
        return file.get_tensor("mean"), file.get_tensor("precision")
