"""`lang3dxl attach`: words for a splat that any program made."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from lang3dxl_ns.attachment import AttachConfig
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.settings_help import showing


@showing(
    *("splat", "data", "out", "text", "clip", "quality", "views", "up", "foreground", "segment"),
    *("workers", "cache_dir"),
)
@dataclass(kw_only=True)
class Attach(AttachConfig):
    """Give words to a finished splat: write a scene that answers any text, without training colors again.

    Reads PLY files of any program (also SuperSplat's compressed ones), .spz, .splat, gsplat's checkpoints,
    and runs of nerfstudio's splatfacto. With --data, words are learned from the splat's photos. Without it,
    they are learned from views of the splat itself, which is less accurate.
    """

    splat: tyro.conf.Positional[Path]
    """File of the splat, or the folder of its run."""
    data: Path | None = None
    """Photos of the splat, with a COLMAP model, with a transforms.json, or alone, or a video."""
    out: Path
    """Scene file to write, NAME.scene."""
    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Texts to search for at the end ("windows; towers"), with a picture of the best view of each."""

    def main(self) -> None:
        from lang3dxl_ns.attachment.attach import attach

        self.check()
        scene = attach(self.splat, self.data, self.out, self)
        if self.text:
            _show(scene, self.text, self.out)
        say(f'Ask it: lang3dxl query {self.out} --text "windows" --out found')


def _show(scene, texts: list[str], out: Path) -> None:
    """Write a picture of each view that shows a prompt best, named after the prompts."""
    from lang3dxl_ns.common.files import slugs
    from lang3dxl_ns.query.doubt import doubtful
    from lang3dxl_ns.query.match import save_picture, together

    question, shown = scene.ask(texts), dict[str, list]()
    for prompt, view in zip(question.prompts, scene.best_views(question), strict=True):
        shown.setdefault(view, []).append(prompt)
    told = ["; ".join(prompt.text for prompt in prompts) for prompts in shown.values()]
    for (view, prompts), text, slug in zip(shown.items(), told, slugs(told), strict=True):
        matches, picture = scene.matches(scene.ask(prompts), view), out.with_name(f"{out.stem}.{slug}.png")
        save_picture(matches[0].overlay() if len(matches) == 1 else together(matches), picture)
        say(f"{text}, in the view of {view}: {picture}")
    for prompt, doubt in zip(question.prompts, question.doubts, strict=True):
        if advice := doubtful(prompt.text, doubt):
            say(f"  {advice}")
