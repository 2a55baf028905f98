"""Words taught from a live page: its marks become the scene's, as `lang3dxl teach` would keep them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

from lang3dxl_ns.common.errors import DAMAGE, UserError
from lang3dxl_ns.common.files import locked
from lang3dxl_ns.files.scene_file import describe_scene_file, keep_words
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.words.taught_words import Example, known_word


@dataclass
class PageWords:
    """Words that the pages of one server teach."""

    file: Path | None = None
    """Scene file that keeps the words; None: they last as long as the server."""
    _marked: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    """Examples that pages sent, by word, in JSON."""
    _one: Lock = field(default_factory=Lock)

    def teach(self, scene: Scene, content: Mapping[str, Any]) -> tuple[Scene, str]:
        """Teach a word from a page's marks; return the scene with it, and a sentence for the page.

        content: the word's `name`, the name that it had `before`, and all `examples` marked in pages, as
        `Example.to_json` writes them. They replace what pages sent earlier; examples that were taught
        otherwise stay. No example forgets what pages taught. Raises UserError if the content is not of this
        form, or see `Scene.teach`."""
        try:
            name, before = str(content["name"]), str(content["before"])
            examples = [Example.from_json(example) for example in content["examples"]]
        except DAMAGE as error:
            raise UserError(f"these are not marks of a word ({error}): load the page again") from error
        with self._one:
            if self.file is None:
                return self._taught(scene, name, before, examples)
            with locked(self.file.resolve().parent):  # another command that teaches comes first, or waits
                known = {known_word(word.name): word for word in describe_scene_file(self.file)["taught"]}
                scene, told = self._taught(scene.with_words(known.values()), name, before, examples)
                new, keys = scene.words, {known_word(name), known_word(before)}
                keep_words(self.file, {k: new.get(k) for k in keys if new.get(k) is not known.get(k)})
        return scene, told

    def keep_tour(self, content: Mapping[str, Any]) -> str:
        """Keep a page's tour in the scene file, if there is one, and return it. Raises UserError for other
        content."""
        if not isinstance(content, dict) or not isinstance(tour := content.get("tour"), str):
            raise UserError("this is not a tour: load the page again")
        if self.file is not None:
            with self._one, locked(self.file.resolve().parent):
                keep_words(self.file, {}, tour)
        return tour

    def _taught(self, scene: Scene, name: str, before: str, examples: Sequence[Example]) -> tuple[Scene, str]:
        for former in {known_word(before), known_word(name)}:
            scene = self._without_marks(scene, former)
        key = known_word(name)
        others = scene.words[key].examples if key in scene.words else ()
        if not examples:
            return scene, f"The scene forgot {name!r}."
        scene = scene.teach(name, [*others, *examples])
        word = scene.words[key]
        self._marked[key] = [example.to_json() for example in word.examples[len(others) :]]
        place = "It lasts until the server ends." if self.file is None else f"{self.file.name} keeps it."
        return scene, f"Taught by {len(word.examples)} photo{'s' * (len(word.examples) > 1)}. {place}"

    def _without_marks(self, scene: Scene, name: str) -> Scene:
        """Return the scene without what pages marked for a word. Other examples stay."""
        word, ours = scene.words.get(name), self._marked.pop(name, [])
        if word is None or not ours:
            return scene
        left = [example for example in word.examples if example.to_json() not in ours]
        scene = scene.with_words(other for other in scene.words.values() if other is not word)
        return scene.teach(word.name, left) if left else scene
