"""Words taught from a live page: its marks become the scene's, as `lang3dxl teach` would keep them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
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
        keys = {known_word(name), known_word(before)}
        with self._one, nullcontext() if self.file is None else locked(self.file.resolve().parent):
            if self.file is not None:  # another command that teaches comes first, or waits
                scene = scene.with_words(describe_scene_file(self.file)["taught"])
            known = scene.words
            scene, told, marked = self._taught(scene, name, before, examples)
            changed = {k: scene.words.get(k) for k in keys if scene.words.get(k) is not known.get(k)}
            if self.file is not None and changed:
                keep_words(self.file, changed)
            self._marked |= {known_word(before): [], known_word(name): marked}
        return scene, told

    def keep_tour(self, content: Mapping[str, Any], known: str) -> tuple[str, bool]:
        """Keep a page's tour, in the scene file if there is one, unless a tour is there (without a file: the
        `known` one) that the page did not have `before`. Return the tour that is kept now, and whether it is
        the page's. Raises UserError for other content."""
        told = [content.get(name) for name in ("tour", "before")] if isinstance(content, dict) else []
        if [*map(type, told)] != [str, str]:
            raise UserError("this is not a tour: load the page again")
        tour, before = map(str, told)
        with self._one, nullcontext() if self.file is None else locked(self.file.resolve().parent):
            kept = known if self.file is None else describe_scene_file(self.file)["provenance"].tour
            if kept not in ("", before, tour):
                return kept, False
            if self.file is not None:
                keep_words(self.file, {}, tour)
        return tour, True

    def _taught(
        self, scene: Scene, name: str, before: str, examples: Sequence[Example]
    ) -> tuple[Scene, str, list[dict[str, Any]]]:
        """Return the scene, the sentence for the page, and the examples of pages that the word has now."""
        for former in {known_word(before), known_word(name)}:
            scene = self._without_marks(scene, former, examples)
        key = known_word(name)
        others = scene.words[key].examples if key in scene.words else ()
        if not examples:
            stay = f"Examples that were taught elsewhere stay ({len(others)}): lang3dxl words"
            remedy = f"{shlex.quote(str(self.file or 'SCENE'))} --forget {shlex.quote(name)}"
            return scene, f"{stay} {remedy}" if others else f"The scene forgot {name!r}.", []
        scene = scene.teach(name, [*others, *examples])
        word = scene.words[key]
        place = "It lasts until the server ends." if self.file is None else f"{self.file.name} keeps it."
        told = f"Taught by {len(word.examples)} photo{'s' * (len(word.examples) > 1)}. {place}"
        return scene, told, [example.to_json() for example in word.examples[len(others) :]]

    def _without_marks(self, scene: Scene, name: str, examples: Sequence[Example]) -> Scene:
        """Return the scene without what pages marked for a word: in this server's time, or earlier and among
        these examples. Others stay."""
        word, ours = scene.words.get(name), self._marked.get(name, [])
        if word is None:
            return scene
        left = [e for e in word.examples if e.to_json() not in ours and not any(n.has(e) for n in examples)]
        if len(left) == len(word.examples):
            return scene
        scene = scene.with_words(other for other in scene.words.values() if other is not word)
        return scene.teach(word.name, left) if left else scene
