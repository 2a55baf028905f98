"""`lang3dxl things`: single things of a scene, listed, counted and asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import tyro

from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import OfScene, showing


@showing("scene", "text", "ask", "out", "splats", "view")
@dataclass(kw_only=True)
class ListThings(OfScene):
    """List the single things that words name: windows, portals, towers. --out gets things.json (boxes,
    scores, photos, relations), things.csv, instances.json (COCO boxes in all photos) and things.png
    (numbered boxes)."""

    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Word for things, such as windows. Repeat the flag for more."""
    ask: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Question, such as "how many windows", "highest tower", "third window from the left" or "windows above
    the portal". Repeat the flag for more."""
    view: str | None = None
    """Photo from which left and right are told (default: the one that shows the things best)."""
    out: Path | None = None
    """Folder for the files."""
    splats: bool = False
    """Write a splat file for each thing too, and scene.glb with things as features (EXT_mesh_features)."""

    def main(self) -> None:
        from lang3dxl_ns.open_scene import load_scene
        from lang3dxl_ns.query.text import caution
        from lang3dxl_ns.things.grammar import answer, parse, sight_of, unsure
        from lang3dxl_ns.things.write import write_catalog, write_picture, write_things

        requests = [(text, parse(text)) for text in self.ask]
        words = list(dict.fromkeys([*self.text, *(word for _, asked in requests for word in asked.words)]))
        if not words:
            raise UserError("give --text or --ask: say which things to look for, such as --text windows")
        if self.splats and self.out is None:
            raise UserError("--splats writes files: give --out too")
        scene = load_scene(self.scene, clip=self.clip)
        if self.view is not None:
            scene.file.photo(self.view)
        answers = scene.things(words)
        by_word = dict(zip(words, answers, strict=True)) if len(answers) == len(words) else {}
        for one in answers:
            say(f"{one.word}: {one.count}" + (f" ({one.caution})" if one.caution else ""))
            if one.word not in scene.words and (advice := caution(one.word)):
                say(f"  {advice}")
        for text, request in requests:
            if not by_word:
                raise UserError("--text holds several prompts: repeat the flag instead")
            named = [by_word[word] for word in request.words]
            sight = partial(sight_of, scene, photo=self.view)
            chosen = answer(request, named, sight)
            whole = request.count and not (request.relation or request.without)
            told = by_word[request.word].count if whole else str(len(chosen))
            if chosen and not request.count:
                told += ": " + some([f"{thing.id} in {thing.sightings[0].photo}" for thing in chosen])
            doubt = None if whole else unsure(request, named, sight)  # the range of a count tells it
            say(f"{text}: {told}" + (f" (unsure, since {doubt})" if doubt else ""))
        if self.out is not None:
            write_catalog(scene, answers, self.out)
            write_picture(scene, answers, self.out / "things.png")
            if self.splats:
                write_things(scene, answers, self.out / "splats")
            say(f"Wrote the things to {self.out}")
