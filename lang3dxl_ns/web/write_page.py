"""The web page of a scene: all its files, with a vocabulary of words that it answers by itself."""

from __future__ import annotations

import gzip
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import make_folder, replace_file
from lang3dxl_ns.common.pictures import PHOTO_SUFFIXES
from lang3dxl_ns.files.scene_file import Provenance
from lang3dxl_ns.query import view_ranking
from lang3dxl_ns.query.ask import prompts_of
from lang3dxl_ns.query.doubt import BEST, DOUBTFUL, DOUBTFUL_TAUGHT, LEAST_PEAK
from lang3dxl_ns.query.heat_maps import PROMPT_COLORS
from lang3dxl_ns.query.language import TABLE
from lang3dxl_ns.query.negatives import CLEAR, NOTHING, competitors
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt, tidy, why_no_words
from lang3dxl_ns.query.thresholds import EVEN, SHARE
from lang3dxl_ns.query.trust import ALIKE, ANCHORS, CLEARLY, FAINT, FAR, STRICTER, STRICTEST
from lang3dxl_ns.query.visibility import spread
from lang3dxl_ns.query.vocabulary import (
    closest_word,
    common_words,
    same_thing,
    searched,
    shipped_vocabulary,
)
from lang3dxl_ns.things import find, grammar, join, outlines, pieces, thing
from lang3dxl_ns.web import pack
from lang3dxl_ns.web.levels import MOST_ROWS, SMALL, Levels, levels_of
from lang3dxl_ns.web.photos import MOST_CAMERAS, extent, photo_json, small_photo
from lang3dxl_ns.web.teach import PageWords
from lang3dxl_ns.words.taught_words import TaughtWord, known_word

_HERE = Path(__file__).parent
_INDEX = _HERE / "index.html"
# The index comes first: it marks the folder of a page whose writing was stopped as ours.
_LIBRARY = _HERE / "splats.js"
_FILES = [_INDEX, *(p for p in _HERE.iterdir() if p.suffix in (".css", ".js", ".txt") and p != _LIBRARY)]
_MADE = ["language.js", "spark.bin"]
"""Files of every page that are made from others, and whose names its modules know."""
_MOST_BYTES = 8_000_000
"""Most bytes of the views that the page flies to, and of the lightings; evenly spaced ones are kept."""
_RULES = {
    **{"best": BEST, "doubtful": DOUBTFUL, "doubtful_taught": DOUBTFUL_TAUGHT, "least_peak": LEAST_PEAK},
    **{"even": EVEN, "share": SHARE, "clear": CLEAR, "alike": ALIKE, "faint": FAINT},
    **{"clearly": CLEARLY, "stricter": STRICTER, "strictest": STRICTEST, "far": FAR},
}
"""Numbers that decide what matches, what is doubtful and what a place is called, for the page's answers."""
_SUGGESTED = (
    "windows", "doors", "towers", "spires", "domes", "minarets", "roof", "arches", "columns", "balconies",
    "statues", "stairs", "chimneys", "clock", "trees", "cars", "grass",
)  # fmt: skip
"""Words that a first visitor is offered, where the scene knows them."""
_NUMBERS = (
    ("ranking", view_ranking, "PEAK LARGE RIM STRONG"),
    ("things", pieces, "LEVELS LEAST PART DEPTH FILLED"),
    ("things", join, "AGREED PARTLY SHARED SPLINTER VIEWS CRUMB OFTEN"),
    ("things", join, "OVER OVERLAP SLIM STRAIGHT LIGHT_PART ROUND CROWN"),
    ("things", thing, "OUTLIERS"),
    ("things", find, "COLORED APART PRESENT TOLD SURE MISSED"),
    ("things", outlines, "LIGHT PLACES SHOWN"),
    ("things", grammar, "BESIDE INSIDE CLOSE"),
)
"""Numbers that rank views, tell things apart and relate them, by the modules that hold them."""
_TEXTS = 256
"""Number of texts encoded at a time."""
_DATA = re.compile(
    r"(splats|codes|field|rows|floaters|foreground|vocabulary|views|(look|photo|part)\d+)\.[0-9a-f]{12}\."
    r"(bin|json|jpg)"
)
"""Names of a page's data files. Nothing else in its folder is ever deleted."""
_Part = tuple[dict[str, Any], dict[str, bytes]]
"""What scene.json tells of a part of a page, and the content of the part's files by name."""
MOST_TEXT = 2_000
"""Most characters of a phrase, of which CLIP reads about 300."""


@dataclass
class Page:
    """The web page of one scene."""

    scene: Scene
    texts: Sequence[str | Prompt] = ()
    """Prompts that the page opens with, as `Scene.prompts` reads them."""
    words: Sequence[str] = ()
    """Words that may name a place, besides the shipped vocabulary of buildings."""
    more: Sequence[str] = ()
    """Further words that the page can search for."""
    provenance: Provenance = field(default_factory=Provenance)
    """Title, credit and license shown on the page."""
    look: str | None = None
    """Training photo whose lighting is shown; default: the overview photo."""
    photos: Path | None = None
    """Folder of the photos, of which the page shows small copies; if None, it shows their cameras alone."""
    live: bool = False
    """Whether a server encodes any other text (`answer`)."""
    own_words: PageWords = field(default_factory=PageWords)
    """Words that are taught from a live page."""
    large: int = SMALL
    """Most Gaussians of a page without levels of detail."""
    left_out: list[str] = field(default_factory=list)
    """Sentences about what the files leave out because of its size."""

    def __post_init__(self) -> None:
        """Parse prompts, merge the Gaussians of a large scene, and pack what Gaussians mean. Raises UserError
        if that is too large for a page, or if a scene without words is asked for texts."""
        self.whole = self.scene
        self.levels: Levels | None = None
        if len(self.scene.splats) > self.large:
            self.levels = levels_of(self.scene, min(self.large, MOST_ROWS))
            self.scene = self.levels.scenes[0]
        scene, within = self.scene, self.scene.config.foreground
        self.prompts = prompts_of(scene, list(self.texts)) if self.texts else []
        self._foreground = prompts_of(scene, within) if within else []
        self._toward = scene.overview.camera.position.to(scene.device)
        means = scene.splats.means[scene.splats.sound()]
        self._center = means.median(0).values if len(means) else self._toward
        self._meaning: pack.PackedMeaning | None = None
        if scene.decoder is not None and scene.codes is not None:
            self._meaning = pack.packed_meaning(scene.decoder, scene.codes)
        elif self.texts:
            raise UserError(why_no_words(scene.file))

    def files(self) -> dict[str, bytes]:
        """Build the content of every file, by name."""
        self.left_out = []
        about, files = dict[str, Any](), {path.name: path.read_bytes() for path in _FILES}
        files["language.js"] = language_module()
        files["spark.bin"] = gzip.compress(_LIBRARY.read_bytes(), mtime=0)
        parts = self._whole, self._details, self._photos, self._lightings, self._answers
        for told, made in (part() for part in parts):
            about |= told
            files |= made
        files["scene.json"] = json.dumps(about | {"left_out": self.left_out}).encode()
        return files

    # ── parts: what scene.json tells of each, and its files ─────────────────────────────────────────────

    def _whole(self) -> _Part:
        """Describe the scene and the page, with the splats that load first."""
        scene, told = self.scene, self.provenance
        about = {
            "title": told.title or Path(scene.file.data).name,
            **{"credit": told.credit, "license": told.license, "made": told.made_how},
            "count": len(scene.splats),
            "center": self._center.tolist(),
            "antialiased": scene.splats.antialiased,
            "background": [0, 0, 0] if scene.background is None else scene.background.tolist(),
            "up": find.up_of(scene).tolist(),
            "upright": find.is_upright(scene),
            "edges": find.axes_of(scene).tolist(),
            "heights": find.heights_of(scene).tolist(),
            "extent": extent(scene),
            "tour": told.tour,
            "meters": None if scene.file.georeference is None else asdict(scene.file.georeference),
            "start": pack.camera_json(scene.overview.full_camera),
            "source": {"scene": Path(scene.file.data).name, "clip": scene.file.clip_identity},
            "colors": PROMPT_COLORS,
            "live": self.live,
            "prompts": _phrases(self.prompts),
        }
        splats = pack.splat_bytes(scene.baked(self.look), self._center, self._toward)
        return about, {"splats.bin": splats.tobytes()}

    def _details(self) -> _Part:
        """Pack the chunks that show more detail: splats, floaters, and what the Gaussians mean."""
        if (levels := self.levels) is None:
            return {}, {}
        files, colored = dict[str, bytes](), [scene.baked(self.look) for scene in levels.scenes]
        for number in tracked(range(1, levels.chunks), "packing details"):
            scene, rows = levels.chunk(number)
            splats = colored[levels.scenes.index(scene)].select(torch.arange(rows.start, rows.stop))
            drawn = pack.splat_bytes(splats, self._center, self._toward).tobytes()
            parts = [drawn, _bytes(scene.floating[rows])]
            if scene.decoder is not None and scene.codes is not None:
                meaning = pack.packed_meaning(scene.decoder, scene.codes[rows]).files
                parts.append(meaning.get("codes.bin") or meaning["rows.bin"])
            files[f"part{number}.bin"] = b"".join(parts)
        bounds = [levels.bounds(number) for number in range(levels.chunks)]
        return {"detail": {"rows": levels.rows, "chunks": bounds, "count": len(self.whole.splats)}}, files

    def _photos(self) -> _Part:
        """Describe the photos' cameras, and make small photos if asked for."""
        names, files = dict[str, str](), dict[str, bytes]()
        shown = spread([photo for photo in self.scene.photos if photo.split == "train"], MOST_CAMERAS)
        if self.photos is not None and self.live:
            names = {photo.name: f"api/photo?name={quote(photo.name)}" for photo in shown}
        elif self.photos is not None:
            made = {p.name: small_photo(p, self.photos) for p in tracked(shown, "reading photos")}
            chosen = self._within_limits("photos", list(made), list(map(len, made.values())))
            names = {name: f"photo{i}.jpg" for i, name in enumerate(chosen)}
            files = {file: made[name] for name, file in names.items()}
        return {"cameras": [photo_json(photo, names.get(photo.name)) for photo in shown]}, files

    def _lightings(self) -> _Part:
        """Tell where floaters and lightings are: without a server they are files, read when chosen."""
        looks = list(self.scene.looks.names) if self.scene.looks else []
        if self.live:
            served = {name: f"api/look?photo={quote(name)}" for name in looks}
            return {"floaters": "api/floaters", "looks": served}, {}
        chosen = self._within_limits("lightings", looks, [4 * len(self.scene.splats)] * len(looks))
        names = {name: f"look{i}.bin" for i, name in enumerate(chosen)}
        files = {file: self.colors(name) for name, file in names.items()}
        return {"floaters": "floaters.bin", "looks": names}, files | {"floaters.bin": self.floaters()}

    def _answers(self) -> _Part:
        """Pack what a page is asked with: what Gaussians mean, words that it knows and offers, and views that
        it flies to."""
        scene, meaning = self.scene, self._meaning
        if meaning is None:
            return {"words": None, "wordless": why_no_words(scene.file), "names": [], "suggested": []}, {}
        rules = {
            "temperature": scene.engine.temperature,
            "threshold": scene.config.threshold,
            "unrelated": scene.doubts.unrelated.tolist(),
            "gap": scene.gap,
            "covered": scene.config.min_alpha,
            "rules": _RULES,
            "foreign": scene.foreignness,
            "pixels": [pack.LEAST_PIXELS, pack.PIXEL_STEPS],
        }
        # Single words need no protection from being split, and CLIP's have "and" and "not" among them.
        phrases = [word for word in (*self.words, *self.more) if " " in word]
        seen, named = scene.visible, [*(word.name for word in scene.words.values()), *phrases]
        packed = {name: pack.view_bytes(view, len(scene.splats)) for name, view in seen.items()}
        views = self._within_limits("views", list(packed), list(map(len, packed.values())))
        about = {
            "words": meaning.description | rules,
            "foreground": _phrases(self._foreground),
            "names": _distinct(named),
            "suggested": self._suggested(),
            "views": [
                {"name": n, "bytes": len(packed[n]), **pack.camera_json(seen[n].camera)} for n in views
            ],
        }
        files = meaning.files | self._vocabulary(meaning)
        files["views.bin"] = b"".join(packed[name] for name in views)
        if self._foreground:
            within = scene.ask(self._foreground, foreground="").gaussians.any(0)
            files["foreground.bin"] = within.byte().cpu().numpy().tobytes()
        return about, files

    def _suggested(self) -> list[str]:
        """List words that the scene answers surely, each with matches of its own: taught ones come first."""
        words = [*(word.name for word in self.scene.words.values()), *_SUGGESTED]
        question, chosen = self.scene.ask([Prompt(word) for word in words]), list[int]()
        for row, (trust, own) in enumerate(zip(question.trusts, question.gaussians, strict=True)):
            others = question.gaussians[chosen]
            same = (own & others).sum(1) > ALIKE * (own | others).sum(1)
            if trust.level == "sure" and bool(own.any()) and not bool(same.any()):
                chosen.append(row)
        return [words[row] for row in chosen]

    def _within_limits(self, what: str, names: list[str], sizes: list[int]) -> list[str]:
        """Choose evenly spaced names that take at most `_MOST_BYTES`, and record how many are left out."""
        count = len(names)
        while count and sum(spread(sizes, count)) > _MOST_BYTES:
            count -= 1
        if count < len(names):
            self.left_out.append(f"{len(names) - count} of {len(names)} {what} are left out, to load quickly")
        return spread(names, count)

    def _vocabulary(self, meaning: pack.PackedMeaning) -> dict[str, bytes]:
        """Encode the words that the page knows: those that may name a place first, then all others."""
        negatives, taught = list(self.scene.text.config.negatives), self.scene.words
        asked = [phrase for phrases in _phrases(self.prompts) for phrase in phrases]
        naming = _distinct([*shipped_vocabulary(), *self.words, *asked])
        others = [*(word.name for word in taught.values()), *common_words(), *ANCHORS, *self.more]
        words = _distinct([*naming, *others])
        numbers = [*self._encoded(meaning, negatives), *self._encoded(meaning, words)]
        count = len(negatives) + len(words)
        special, learned = {}, {}
        for i, word in enumerate(words):
            known, renamed = taught.get(known_word(word)), searched(word) != word  # haus: house
            if i < len(naming) or known is not None or renamed or self.scene.text.synonyms(word):
                near, against = self._meant(meaning, word)
            else:
                near, against = numbers[0][:1], competitors(negatives, [word])
            if len(near) > 1 or renamed:
                special[i] = [list(range(count, count + len(near))), against]
                numbers.append(near)
                count += len(near)
            elif len(against) < len(negatives):
                special[i] = [[len(negatives) + i], against]
            if known is not None:  # what examples taught, in the scene's own numbers
                learned[i] = self._taught(meaning, known)
        described = {"negatives": negatives, "words": words, "naming": len(naming), "special": special}
        described["common"] = len(shipped_vocabulary())
        described["nothing"] = [i for i, phrase in enumerate(negatives) if phrase in NOTHING]
        described["taught"] = learned
        described["anchors"] = {
            anchor: [known_word(word) for word in words if same_thing(anchor, [word])] for anchor in ANCHORS
        }
        listed = json.dumps(described).encode()
        return {"vocabulary.json": listed, "vocabulary.bin": pack.halves(torch.cat(numbers))}

    def _meant(self, meaning: pack.PackedMeaning, word: str) -> tuple[Float[Tensor, "s r"], list[int]]:
        """Return the vectors searched for along with a word, and the negatives that it competes with."""
        queries = self.scene.queries(prompts_of(self.scene, [Prompt(word)]))
        return meaning.of_texts(queries.vectors[list(queries.positive[0])]).cpu(), list(queries.negative[0])

    def _encoded(self, meaning: pack.PackedMeaning, texts: list[str]) -> Iterator[Float[Tensor, "m r"]]:
        parts = [texts[row : row + _TEXTS] for row in range(0, len(texts), _TEXTS)]
        for part in tracked(parts, "encoding words"):
            yield meaning.of_texts(self.scene.text.vectors(part).to(self.scene.device)).cpu()

    # ── what a live server adds ─────────────────────────────────────────────────────────────────────────

    def answer(self, phrase: str) -> dict[str, Any]:
        """Express a phrase in this scene's numbers: itself, what is searched for, and what it competes with.
        Raises UserError if the phrase is empty, or the scene has no words."""
        if self._meaning is None:
            raise UserError(why_no_words(self.scene.file))
        text = tidy(phrase[:MOST_TEXT].encode("utf-8", "ignore").decode())
        if not text:
            raise UserError("the prompt is empty: type what to look for, such as rose window")
        near, against = self._meant(self._meaning, text)
        own = next(self._encoded(self._meaning, [text]))[0].tolist()
        meant = closest_word(text, (*self.scene.words, *common_words()))
        told: dict[str, Any] = {"own": own, "near": near.tolist(), "against": against, "meant": meant}
        known = self.scene.words.get(known_word(text))
        return told if known is None else told | {"taught": self._taught(self._meaning, known)}

    def _taught(self, meaning: pack.PackedMeaning, word: TaughtWord) -> dict[str, Any]:
        """Express what examples taught in this scene's own numbers."""
        vector = meaning.of_texts(word.vector[None].to(self.scene.device))[0].tolist()
        return {"vector": vector, "bias": word.bias, "text": word.text, "doubt": word.doubt}

    def teach(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Teach the scene a word that is marked in the page; see `PageWords.teach`."""
        self.whole, told = self.own_words.teach(self.whole, content)
        self.scene = self.scene.with_words(self.whole.words.values()) if self.levels else self.whole
        return {"told": told}

    def keep_tour(self, content: Mapping[str, Any]) -> None:
        """Keep a tour, which the page then opens with; see `PageWords.keep_tour`. Raises UserError if another
        tour than the page knows is kept by now."""
        tour, ours = self.own_words.keep_tour(content, self.provenance.tour)
        self.provenance = replace(self.provenance, tour=tour)
        if not ours:
            raise UserError("another tab kept another one: open the page again, without # and what follows")

    def photo(self, name: str) -> bytes:
        """Read a small copy of a photo. Raises UserError if there is none."""
        if self.photos is None:
            raise UserError("the photos are not at hand: name their folder with --photos")
        return small_photo(self.scene.file.photo(name), self.photos)

    def floaters(self) -> bytes:
        """Compute how surely each Gaussian is a floater, a byte each."""
        return _bytes(self.scene.floating)

    def colors(self, photo: str) -> bytes:
        """Compute every Gaussian's color and opacity in a photo's look. Raises UserError if there is none."""
        return pack.color_bytes(self.scene.baked(photo), self._toward).tobytes()


def language_module() -> bytes:
    """Write the table of what people type, and the numbers by which views are ranked, as a module."""
    table = {name: value for name, value in TABLE.items() if name != "cases"}
    table |= {"ranking": {}, "things": {}, "grammar": grammar.table()}
    for part, module, names in _NUMBERS:
        table[part] |= {name: getattr(module, name) for name in names.split()}
    return f"export default {json.dumps(table, ensure_ascii=False)};\n".encode()


def _bytes(shares: Float[Tensor, " n"]) -> bytes:
    return (shares * 255).round().byte().cpu().numpy().tobytes()


def _phrases(prompts: Sequence[Prompt]) -> list[list[str]]:
    """List each prompt's text with its negatives."""
    return [[prompt.text, *prompt.negatives] for prompt in prompts]


def _distinct(phrases: Sequence[str]) -> list[str]:
    """Return the phrases in the form in which the page compares them, each once."""
    return list(dict.fromkeys(filter(None, map(tidy, phrases))))


def write_page(page: Page, folder: Path) -> int:
    """Write a page's files into a folder for any static web server; return the number of bytes. Raises
    UserError for a folder that has files of these names, or pictures, and is not such a page."""
    make_folder(folder)
    index, own = folder / _INDEX.name, [*(path.name for path in _FILES), *_MADE]
    ours = index.is_file() and "<title>A scene to ask</title>" in index.read_text(errors="replace")
    names, other = {*own, "scene.json", "vocabulary.json"}, (".bin", *PHOTO_SUFFIXES)
    here = sorted(folder.iterdir())
    taken = [path.name for path in here if path.name in names or path.suffix.lower() in other]
    if taken and not ours:  # whoever serves a folder of photos would publish them
        raise UserError(f"{folder} holds {taken[0]}, which is not a scene's page: name a folder of its own")
    files = page.files()
    data = sorted(files.keys() - {*own, "scene.json"})
    # Data have names by content, which scene.json lists: a page whose writing is stopped, or whose files a
    # browser or a copy keeps from earlier, never shows the splats of one scene with the words of another.
    hashes = {name: hashlib.sha256(files[name]).hexdigest()[:12] for name in data}
    named = {name: f"{Path(name).stem}.{short}{Path(name).suffix}" for name, short in hashes.items()}
    about = json.loads(files["scene.json"]) | {"files": named}
    for camera in about["cameras"]:
        camera["photo"] = named.get(camera["photo"], camera["photo"])
    for name in own[:1] if not ours else []:  # marks the folder as ours
        replace_file(folder / name, files[name])
    for name, stored in named.items():
        replace_file(folder / stored, files[name])
    files["scene.json"] = json.dumps(about).encode()
    for name in [*own, "scene.json"]:
        replace_file(folder / name, files[name])
    for path in here:  # of the page that this one replaces
        if ours and _DATA.fullmatch(path.name) and path.name not in named.values():
            path.unlink(missing_ok=True)
    return sum(map(len, files.values()))
