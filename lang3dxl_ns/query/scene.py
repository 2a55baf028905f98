"""`Scene`: a finished scene that can be rendered and queried."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, overload

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.query import answer
from lang3dxl_ns.query import ask as asking
from lang3dxl_ns.query.answering import Answering
from lang3dxl_ns.query.ask import Text
from lang3dxl_ns.query.floaters import FLOATS, floating
from lang3dxl_ns.query.match import Found, Match
from lang3dxl_ns.query.question import Question
from lang3dxl_ns.query.rendered_scene import Place
from lang3dxl_ns.query.text import texts_of
from lang3dxl_ns.query.vocabulary import shipped_vocabulary
from lang3dxl_ns.words.taught_words import Example, TaughtWord, known_word
from lang3dxl_ns.words.teach import carried_word, learned_word, least_certain_photo

if TYPE_CHECKING:
    from lang3dxl_ns.things.find import Things
    from lang3dxl_ns.things.grammar import Answer

_ROWS = 65_536
"""Number of Gaussians decoded at a time."""


@dataclass(eq=False, repr=False)
class Scene(Answering):
    """A scene: Gaussians, what they mean, and the photos they were made from.

    The scene never changes. Results that are computed from it once (decoded features, the Gaussians that each
    photo shows) are kept. Any number of threads may use one scene.
    """

    def __repr__(self) -> str:
        held_out = sum(photo.held_out for photo in self.photos)
        colors = "only colors" if self.file.clip is None else "no words yet"
        words = f"CLIP {self.file.clip}" if self.decoder is not None else colors
        return (
            f"Scene({len(self.splats):,} Gaussians, {len(self.photos)} photos ({held_out} held out) "
            f"of {self.file.data}, {words})"
        )

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    def ask(
        self,
        texts: Text | Sequence[Text],
        *,
        negatives: Sequence[str] = (),
        foreground: str | None = None,
        threshold: float | None = None,
    ) -> Question:
        """Put prompts to the scene.

        Args:
            texts: prompts as `parse_prompts` reads them ("dome; rose window", '"windows" not "arcades"'), or
                vectors.
            negatives: phrases that all prompts compete with, besides their own.
            foreground: prompts that matches must lie on, such as "building"; default: the configured ones.
            threshold: relevancy above which places match, 0…1; default: the configured one, or else chosen
                for the scene (`match_thresholds`).

        Raises:
            UserError: there is no prompt, one is its own negative, the threshold is impossible, or the scene
                has colors only.
        """
        return asking.ask(self, texts, negatives, foreground, threshold)

    @overload  # a text is a sequence of texts too, and the first form is meant
    def query(  # type: ignore[overload-overlap]
        self,
        texts: Text,
        place: Place | None = None,
        *,
        negatives: Sequence[str] = (),
        size: int | None = None,
        threshold: float | None = None,
    ) -> Match: ...

    @overload
    def query(
        self,
        texts: Sequence[Text],
        place: Place | None = None,
        *,
        negatives: Sequence[str] = (),
        size: int | None = None,
        threshold: float | None = None,
    ) -> list[Match]: ...

    def query(
        self,
        texts: Text | Sequence[Text],
        place: Place | None = None,
        *,
        negatives: Sequence[str] = (),
        size: int | None = None,
        threshold: float | None = None,
    ) -> Match | list[Match]:
        """Find matches in a view: return a `Match` for one text, a list of them for several texts, or for a
        text that holds several prompts.

        Args:
            texts, negatives, threshold: see `ask`.
            place: a photo's name (matches are restricted to its foreground), a camera or a pose; None: for
                each prompt the training view that shows it best.
            size: longer side in pixels, see `camera`.

        Raises:
            UserError: see `ask` and `camera`.
        """
        question = self.ask(texts, negatives=negatives, threshold=threshold)
        if place is not None:
            return _one_or_all(texts, answer.matches(self, question, place, size))
        best = answer.best_views(self, question)
        seen = {photo: answer.matches(self, question, photo, size) for photo in dict.fromkeys(best)}
        return _one_or_all(texts, [seen[photo][row] for row, photo in enumerate(best)])

    def matches(self, question: Question, place: Place, size: int | None = None) -> list[Match]:
        """Find matches of a question's prompts in one view; see `query`."""
        return answer.matches(self, question, place, size)

    @overload
    def find(  # type: ignore[overload-overlap]
        self, texts: Text, *, negatives: Sequence[str] = (), threshold: float | None = None, most: int = 10
    ) -> Found: ...

    @overload
    def find(
        self,
        texts: Sequence[Text],
        *,
        negatives: Sequence[str] = (),
        threshold: float | None = None,
        most: int = 10,
    ) -> list[Found]: ...

    def find(
        self,
        texts: Text | Sequence[Text],
        *,
        negatives: Sequence[str] = (),
        threshold: float | None = None,
        most: int = 10,
    ) -> Found | list[Found]:
        """Find matches in the scene: return a `Found` with at most `most` views for one text, a list of
        them for several, as `query` does. For the other arguments see `ask`. Raises UserError as `ask` does,
        and if `most` is below 1."""
        if most < 1:
            raise UserError(f"{most} views are requested: give 1 or more")
        question = self.ask(texts, negatives=negatives, threshold=threshold)
        return _one_or_all(texts, answer.locate(self, question, most))

    def relevancy(self, text: Text) -> Float[Array, " n"]:
        """Compute the relevancy of every Gaussian to one prompt, 0…1; 0 for Gaussians visible in no photo.
        Raises UserError as `ask` does, and for a text that holds several prompts."""
        return asking.ask_one(self, text).relevancy[0].cpu().float().numpy()

    def export(
        self,
        path: str | Path,
        text: Text | None = None,
        *,
        threshold: float | None = None,
        everything: bool = False,
        look: str | None = None,
        index: str | Path | None = None,
        hide_floaters: bool = False,
    ) -> int:
        """Write the Gaussians as a .ply, .spz, .sog or .glb file for splat viewers, in the scene's order, and
        return how many were written.

        Args:
            text: prompt; only the Gaussians that match it are written. None: all Gaussians are written.
            threshold: see `ask`.
            everything: with a text, write all Gaussians; a PLY has their relevancy as a property.
            look: training photo whose lighting is baked into the colors; default: the overview photo.
            index: with a text, a .npy or .txt file for the numbers of the matching Gaussians: their
                positions, from 0, in the scene, and so in the splat that it was attached to.
            hide_floaters: leave out the Gaussians that `floating` takes for floaters.

        Raises:
            UserError: nothing matches, or see `ask` and `write_splats`.
        """
        from lang3dxl_ns.files.splat_file import write_matching, write_splats  # formats that asking needs not

        splats = self.baked(look)
        path, place = expanded(path), self.file.georeference
        solid = self.floating <= FLOATS if hide_floaters else None
        if text is None:
            return write_splats(path, splats if solid is None else splats.select(solid), place=place)
        question = asking.ask_one(self, text, threshold)
        return write_matching(path, splats, question, everything, index, solid, place)

    @cached_property
    def floating(self) -> Float[Tensor, " n"]:
        """How surely each Gaussian is a floater, 0…1."""
        return floating(self.splats, self.visible, self.draw)

    # ── what is where ───────────────────────────────────────────────────────────────────────────────

    def what_is(
        self,
        place: Place,
        x: float,
        y: float,
        *,
        words: Sequence[str] | None = None,
        most: int = 5,
        size: int | None = None,
    ) -> list[tuple[str, float]]:
        """Find at most `most` of the `words` (default: the shipped vocabulary of buildings) that match a
        pixel best, with their relevancy, best first. x, y: its column and row in the view; see `camera`.

        The result is empty where the scene's Gaussians hardly cover the pixel or have no meaning, and at the
        sky: where the sky or a generic phrase matches best, and no word is clearly better. Raises UserError
        if the pixel lies outside the view.
        """
        words = shipped_vocabulary() if words is None else texts_of(words, "a word")
        return answer.words_at(self, self.camera(place, size), x, y, words, most)

    def things(self, texts: Text | Sequence[Text]) -> list[Things]:
        """Find the single things that each prompt of `texts` (see `ask`) names: windows, portals, towers."""
        from lang3dxl_ns.things.find import things_of  # whose scipy opening does not need

        return things_of(self, self.ask(texts))

    def answer(self, question: str, view: str | None = None) -> Answer:
        """Answer a question about things, such as "how many windows" or "the window left of the portal".

        Args:
            question: a sentence of the grammar of docs/things.md.
            view: photo from which left and right are told, among what it shows; default: the one that shows
                most of the things, as if it showed all.

        Raises:
            UserError: the grammar doesn't know the question, what it refers to is not found, or no photo has
                this name.
        """
        from lang3dxl_ns.things.grammar import answer_question

        return answer_question(self, question, view)

    # ── features ────────────────────────────────────────────────────────────────────────────────────

    def encode(self, texts: str | Sequence[str]) -> Float[Array, "n c"]:
        """Encode texts as unit vectors in the scene's CLIP space: [c] for a string, [n, c] for a list."""
        vectors = self.text.vectors(texts).cpu().numpy()
        return vectors[0] if isinstance(texts, str) else vectors

    @property
    def features(self) -> Float[Array, "n c"]:
        """Unit CLIP features of all Gaussians in half precision; 0 for those visible in no photo. Each access
        decodes them, in parts: 1 GB for a million Gaussians with 512 channels."""
        rows = range(0, len(self.splats), _ROWS)
        parts = [self.engine.features(slice(row, row + _ROWS)).cpu().half().numpy() for row in rows]
        return np.concatenate(parts) if parts else np.zeros((0, 0), np.float16)

    # ── words taught by example ─────────────────────────────────────────────────────────────────────

    def teach(
        self, word: str, examples: Example | Sequence[Example], selection: Bool[Tensor, " n"] | None = None
    ) -> Scene:
        """Return a scene that also knows a word, as `scene.words[word]`, and uses what it learned wherever
        the word is a prompt; this scene is unchanged. Examples that the word had before are replaced.

        Args:
            word: the word, in any case.
            examples: marks in photos of the scene.
            selection: the Gaussians that are the word, if known; default: those that the marks show.

        Raises:
            UserError: the marks show nothing or everything, or lie outside their photos; or a prompt of this
                word would mean something else.
        """
        listed = [examples] if isinstance(examples, Example) else list(examples)
        return self.with_words([*self.words.values(), learned_word(self, word, listed, selection)])

    def with_words(self, words: Iterable[TaughtWord]) -> Scene:
        """Return this scene with other taught words (the last of equal names), sharing its results."""
        changed = copy.copy(self)
        changed.words = {known_word(word.name): word for word in words}
        return changed

    def carrying(self, word: TaughtWord) -> Scene:
        """Return a scene with a word taught elsewhere. If it was taught in these photos, of which a few may
        be gone, it is learned anew; if not, or if its marks no longer show anything, it is kept as it was
        learned there. Raises UserError if it was learned with another CLIP."""
        return self.with_words([*self.words.values(), carried_word(self, word)])

    def unsure(self, word: str) -> str:
        """Find the training photo in which a taught word is least certain, the best one to mark next. Raises
        UserError if the word was not taught."""
        return least_certain_photo(self, word)


Result = TypeVar("Result", Match, Found)


def _one_or_all(texts: object, found: list[Result]) -> Result | list[Result]:
    """Return all answers to a list of texts, or to a text that holds several prompts; else the only one."""
    return found if isinstance(texts, list | tuple) or len(found) > 1 else found[0]
