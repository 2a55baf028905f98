"""`lang3dxl things`: single things of a scene, listed, counted and asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from lang3dxl_ns.commands.of_scene import OfScene
from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing


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
        from lang3dxl_ns.files.coco import check_labels_file
        from lang3dxl_ns.open_scene import load_scene
        from lang3dxl_ns.query.ask import prompts_of
        from lang3dxl_ns.query.text import Prompt
        from lang3dxl_ns.things.grammar import Request, answered, facing, meant, parse
        from lang3dxl_ns.things.write import each_word_once, table, write_catalog, write_picture, write_things

        if not (self.text or self.ask):
            raise UserError("give --text or --ask: say which things to look for, such as --text windows")
        if self.splats and self.out is None:
            raise UserError("--splats writes files: give --out too")
        if self.out is not None:
            check_labels_file(self.out / "things.json")
            check_labels_file(self.out / "instances.json")
        scene = load_scene(self.scene, clip=self.clip)
        if self.view is not None:
            scene.file.photo(self.view)
        requests, refused = dict[str, Request](), list[str]()
        for text in dict.fromkeys(self.ask):
            try:
                requests[text] = parse(text, scene.words)
            except UserError as error:
                refused.append(_refusal(text, error))
        asked = [Prompt(word) for request in requests.values() for word in request.words]
        own = dict.fromkeys(prompts_of(scene, self.text) if self.text else ())
        prompts = list(own | dict.fromkeys(prompts_of(scene, asked) if asked else ()))
        answers = scene.things(prompts) if prompts else []
        by_word = {p.text: one for p, one in zip(prompts, answers, strict=True) if not p.negatives}
        for prompt, one in zip(prompts, answers, strict=True):
            say(f"{one.word}: {one.count}" + (f" ({one.caution})" if one.caution else ""))
            if prompt.taught is None and (other := meant(prompt.text, scene.words)):
                say(f"  did you mean {other}?")
        named = each_word_once(answers[: len(own)])
        if any(one.things for one in named):
            say(*table(scene, named))
        for text, request in requests.items():
            try:
                found = [by_word[word] for word in request.words]
                view = facing(scene, request, found, self.view)
                say(f"{text}: {answered(request, found, view)}")
            except UserError as error:
                refused.append(_refusal(text, error))
        if self.out is not None and answers:
            listed = each_word_once(answers)
            write_catalog(scene, listed, self.out)
            write_picture(scene, listed, self.out / "things.png")
            new = write_things(scene, listed, self.out / "splats") if self.splats else []
            say(f"Wrote the things to {self.out}")
            if old := sorted(path.name for path in {*(self.out / "splats").glob("*.*")} - {*new}):
                say(f"{self.out / 'splats'} has files that are not of this call: {some(old)}")
        if not self.text and len(refused) == len({*self.ask}):
            raise UserError("; ".join(refused))
        say(*refused)


def _refusal(question: str, error: UserError) -> str:
    """Say why a question has no answer, with the question unless the reason begins with it."""
    return str(error) if str(error).startswith(question) else f"{question}: {error}"
