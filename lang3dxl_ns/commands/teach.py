"""`lang3dxl teach` and `lang3dxl words`: words taught by example."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

from lang3dxl_ns.commands.of_scene import OfScene
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import file_locked
from lang3dxl_ns.common.settings_help import showing

if TYPE_CHECKING:
    from lang3dxl_ns.query.scene import Scene
    from lang3dxl_ns.words.taught_words import Example, TaughtWord


@showing("scene", "word", "photo", "mask", "box", "at", "not_at")
@dataclass(kw_only=True)
class Teach(OfScene):
    """Show a scene what a word means, by marking it in a photo with an outline, a box, or points.

    The scene keeps the word. Further calls add examples, in the same photo or in others. `lang3dxl words`
    lists and removes them. `query`, `export` and the viewer then find the word everywhere.
    """

    scene: tyro.conf.Positional[Path | None] = None
    """A .scene file, or a folder that holds one (default: the newest run under outputs/)."""
    word: str
    """Word to teach."""
    photo: str
    """Name of the photo that is marked."""
    mask: Path | None = None
    """Picture in the photo's proportions that is white on everything that the word means."""
    box: str | None = None
    """Box around everything that the word means, in pixels of the photo: LEFT,TOP,RIGHT,BOTTOM."""
    at: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Point on what the word means, in pixels of the photo: X,Y. Repeat the flag for more."""
    not_at: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Point on something else: X,Y. Repeat the flag for more."""

    def main(self) -> None:
        from lang3dxl_ns.files.scene_file import keep_words
        from lang3dxl_ns.open_scene import existing_scene_file, load_scene
        from lang3dxl_ns.words.taught_words import known_word

        file, name = existing_scene_file(self.scene).resolve(), known_word(self.word)
        example = self._example()
        with file_locked(file):  # another example that is taught at this moment comes first, or waits
            scene = load_scene(file, clip=self.clip)
            before = scene.words[name].examples if name in scene.words else ()
            taught = scene.teach(self.word, [*before, example])
            keep_words(file, {name: taught.words[name]})
        say(*described(taught.words[name]))
        say(f"  most uncertain in {taught.unsure(self.word)}: check it, and mark it there next")

    def _example(self) -> Example:
        from lang3dxl_ns.common.pictures import mask_values
        from lang3dxl_ns.evaluation.layouts import read_gray
        from lang3dxl_ns.words.taught_words import Example

        box = None if self.box is None else _numbers(self.box, 4, "--box LEFT,TOP,RIGHT,BOTTOM")
        points, others = (
            tuple((x, y) for x, y in (_numbers(text, 2, f"{flag} X,Y") for text in texts))
            for texts, flag in ((self.at, "--at"), (self.not_at, "--not-at"))
        )
        mask = None if self.mask is None else np.asarray(read_gray(self.mask, "mask", mask_values)) >= 128
        return Example(self.photo, mask, box, points, others)  # type: ignore[arg-type]


@showing("scene", "forget", "save", "load")
@dataclass(kw_only=True)
class Words(OfScene):
    """List the words that a scene was taught, remove them, or carry them to other scenes of the same CLIP."""

    scene: tyro.conf.Positional[Path | None] = None
    """A .scene file, or a folder that holds one (default: the newest run under outputs/)."""
    forget: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Word to forget, or one of its examples (doors, or doors/2 for the second). Repeat the flag for more."""
    save: Path | None = None
    """File to write the words to."""
    load: Path | None = None
    """File of words to add. Words learned in one scene often fail in another, so check them."""

    def main(self) -> None:
        from lang3dxl_ns.files.scene_file import describe_scene_file, keep_words
        from lang3dxl_ns.open_scene import existing_scene_file, load_scene
        from lang3dxl_ns.words.taught_words import known_word, load_words, save_words

        if self.save is not None and self.save.suffix != ".json":
            raise UserError(f"--save writes words as JSON: {self.save} is not the name of a .json file")
        scene = load_scene(file := existing_scene_file(self.scene), clip=self.clip)
        before = scene.words
        # The last example of a word goes first, so that the numbers of the others stay as they were listed.
        for name in sorted(set(self.forget), key=lambda which: (len(which), which.lower()), reverse=True):
            scene = forgotten(scene, name)
        if self.load is not None:
            for word in load_words(self.load):
                name, own = known_word(word.name), scene.words
                scene = scene.carrying(word)
                if name in own and scene.words[name].lacks_examples_of(own[name]):
                    hint = "--forget it too, or rename it in the file"
                    raise UserError(f"{word.name!r} was taught here by examples, which would be lost: {hint}")
        words = list(scene.words.values())
        if self.forget or self.load is not None:
            changed = {name: scene.words.get(name) for name in {**before, **scene.words}}
            changed = {name: word for name, word in changed.items() if word is not before.get(name)}
            with file_locked(file):
                for word in describe_scene_file(file)["taught"]:
                    name = known_word(word.name)
                    if name in changed and (name not in before or word.to_json() != before[name].to_json()):
                        raise UserError(f"{word.name!r} was taught at this moment: repeat this command")
                keep_words(file, changed)
        if self.save is not None:
            if not words:
                raise UserError("there is no word to save: teach one with lang3dxl teach")
            save_words(self.save, words)
        if not words:
            say("This scene was taught no words yet: lang3dxl teach --word doors --photo NAME --at X,Y")
        for word in words:
            say(*described(word))


def forgotten(scene: Scene, which: str) -> Scene:
    """Return the scene without a word (doors) or an example of it (doors/2). Raises UserError without it."""
    from lang3dxl_ns.words.taught_words import known_word

    name, _, number = which.rpartition("/")
    if known_word(which) in scene.words or not (number.isdecimal() and len(number) < 10):
        name, number = which, ""
    word = scene.words.get(known_word(name))
    if word is None or (number and not 1 <= int(number) <= len(word.examples)):
        raise UserError(f"{which!r} was not taught: lang3dxl words lists what was")
    left = [e for i, e in enumerate(word.examples, start=1) if number and i != int(number)]
    if left:
        return scene.teach(word.name, left)
    return scene.with_words(one for one in scene.words.values() if one is not word)


def described(word: TaughtWord) -> list[str]:
    """Describe a word and its examples in lines."""
    if not word.examples:
        return [f"{word.name}: carried over from {word.scene}, which often fails: check it in a few photos"]
    count = f"{len(word.examples)} example{'s' if len(word.examples) > 1 else ''}"
    lines = [f"{word.name}: taught by {count}, doubt {word.doubt:.2f}"]
    learned = ", learned from the others" if len({e.photo for e in word.examples}) > 1 else ""
    for number, example in enumerate(word.examples, start=1):
        precision = word.precision.get(example.photo)
        score = "" if precision is None else f": average precision {precision:.2f}{learned}"
        lines.append(f"  {number}. {_marks(example)} in {example.photo}{score}")
    return lines


def _marks(example: Example) -> str:
    counts = {"": len(example.points), " elsewhere": len(example.not_points)}
    marked = "outline" if example.mask is not None else "box" if example.box is not None else ""
    points = (f"{n} point{'s' if n > 1 else ''}{where}" for where, n in counts.items() if n)
    return ", ".join(filter(None, [marked, *points]))


def _numbers(text: str, count: int, usage: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise UserError(f"{text!r} is not {usage}: give {count} numbers, separated by commas")
    return numbers
