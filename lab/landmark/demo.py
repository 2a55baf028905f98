"""`lang3dxl demo`: the full workflow on a generated scene, from photos to average precision."""

from __future__ import annotations

import os
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro
from rich import get_console
from rich.markdown import Markdown

from lab.reports import command_line
from lab.stages import MeasuredStages
from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded, read_json
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report
from lang3dxl_ns.common.settings_help import showing

if TYPE_CHECKING:
    from lab.landmark.picture import PictureRow
    from lang3dxl_ns.evaluation.photo_metrics import EvaluatedPhoto
    from lang3dxl_ns.evaluation.score_run import Evaluation
    from lang3dxl_ns.query.match import Match
    from lang3dxl_ns.query.scene import Scene
    from lang3dxl_ns.training.fit import Settings


@showing("out", "quick", "seed")
@dataclass
class Demo:
    """See the full workflow in minutes, without any data: generate a landmark that the built-in CLIP has
    never seen, photograph it, prepare targets, train, and measure how well words find their pixels in novel
    views and held-out photos.

    Ctrl-C stops at any point and keeps what is finished. The same command continues.
    """

    out: Path | None = None
    """Folder for the scene, the run and the report. The default is lang3dxl-demo or, if that holds another
    scene, lang3dxl-demo-2 …"""
    seed: int = 2
    """Seed of the landmark. The built-in CLIP has not seen seeds below 1,000."""
    family: Literal["cathedral", "mosque", "hall", "auto"] = "auto"
    """Kind of building. With auto, the seed chooses it."""
    photos: int | None = None
    """Number of photos. The default is 48; --quick makes it 24."""
    steps: int | None = None
    """Training iterations. The default is 1,200; --quick makes it 250."""
    wild: bool = True
    """Vary sizes, lenses, weather, exposures and passers-by as in photos from the Internet. --no-wild uses
    one camera, one sun and no people."""
    test_views: int | None = None
    """Number of novel views with exact labels to score, besides the held-out photos. The default is 24;
    --quick makes it 8. 0 makes none."""
    quick: bool = False
    """Take a third of the time, with fewer photos, views and iterations. Words are less accurate."""
    clip: str = "builtin"
    """CLIP to use: "builtin", a Hugging Face name, a folder, or "none" for colors only."""
    dense: str = "auto"
    """Dense encoder to use, with the same choices, or "auto", which takes the one that the CLIP needs."""
    train: str = ""
    """Extra flags of `lang3dxl train` in one string: --train="--sky-gaussians 0"."""
    restart: bool = False
    """Train anew, over the run in the folder."""

    def main(self) -> None:
        check_numbers(self, _BOUNDS)
        out = self._folder()
        try:
            self._run(out)
        except (KeyboardInterrupt, SystemExit):
            sys.exit(f"\nStopped. Finished work is kept in {out}; the same command continues.")

    def _run(self, out: Path) -> None:
        from lang3dxl_ns.evaluation.score_run import Evaluation, EvaluationSettings
        from lang3dxl_ns.preparation.model_files import check_encoders
        from lang3dxl_ns.scene.capture import open_capture
        from lang3dxl_ns.training.checkpoint import CHECKPOINT
        from lang3dxl_ns.training.fit import begin

        settings = self.settings(out)
        check_encoders(settings.targets.clip, settings.targets.dense)
        scene, stages = out / "scene", MeasuredStages(_SHARES, out / "stages.json")
        if kept := (scene / "scene.json").exists():
            say("scene: kept from an earlier command")
        with stages.stage("scene"):
            if not kept:
                from lab.landmark.scene_writer import DemoScene, write_scene

                write_scene(DemoScene(out=scene, **{"family": self.family, **self._wanted}))
        if self.restart:
            (out / CHECKPOINT).unlink(missing_ok=True)
        with stages.stage("prepare"):
            run = begin(open_capture(scene), settings, out, scene / "lang3dxl_cache")
            run.title = f"A generated {read_json(scene / 'scene.json')['family']}"
        trained = run.complete(stages)
        with stages.stage("evaluate"):
            evaluation = Evaluation(run.state, run.data, EvaluationSettings())
            photos = list(evaluation.evaluate("held-out"))
            splits = {"Held-out photos": photos}
            if (scene / "test_views").is_dir():
                from lab.landmark.novel_views_of_runs import evaluate_novel_views

                splits = {"Test views": list(evaluate_novel_views(run.state, run.data)), **splits}
            report = self._report(splits, trained)
        report |= stages.figures()
        write_report(out, "report", self.markdown(report), report)
        matches = _scored_matches(trained, evaluation, [photo.name for photo in photos])
        drawn = (_picture_row(photo, evaluation, matches[photo.name]) for photo in photos)
        if rows := [row for row in drawn if row.truth]:
            from lab.landmark.picture import draw_picture, most_telling

            draw_picture(most_telling(rows, 3), out / "report.png")
        get_console().print(Markdown(self.markdown(report)))
        from lab.landmark.picture import CAPTION

        say(f"\nReport: {out / 'report.md'}. Picture: {out / 'report.png'} ({CAPTION})")
        place = shlex.quote(os.path.relpath(out))
        say(
            "Next:",
            f"  walk through it  lang3dxl view {place}",
            f'  ask it           lang3dxl query {place} --text "windows" --out found',
            f"  share it         lang3dxl export {place} --web page",
            "  your own photos  lang3dxl train FOLDER",
        )

    def _folder(self) -> Path:
        """Return the requested folder, or the first default one without another scene. Raises UserError if
        the requested folder holds another scene."""
        if self.out is not None:
            out = expanded(self.out).absolute()
            if difference := self._difference(out):
                raise UserError(f"{difference}: give --out another folder, or remove this one")
            return out
        names = ("lang3dxl-demo", *(f"lang3dxl-demo-{number}" for number in range(2, 1000)))
        return next(out for name in names if not self._difference(out := Path(name).absolute()))

    def _difference(self, out: Path) -> str | None:
        """Say how the scene in a folder differs from the requested one; None if it does not or is missing."""
        path = out / "scene" / "scene.json"
        if not path.exists():
            return None
        try:
            found = dict(read_json(path))
        except (OSError, ValueError, TypeError) as error:
            return f"{path} can't be read ({error})"
        for name, value in self._wanted.items():
            if found.get(name, 0) != value:
                return f"{path.parent} is a scene with {name} {found.get(name, 0)}, not {value}"
        return None

    @property
    def _wanted(self) -> dict[str, Any]:
        """Settings that distinguish the requested scene from others, with their names in scene.json."""
        photos, views = (24, 8) if self.quick else (48, 24)
        wanted = {
            "seed": self.seed,
            "wild": self.wild,
            "photos": photos if self.photos is None else self.photos,
            "test_views": views if self.test_views is None else self.test_views,
        }
        return wanted | ({} if self.family == "auto" else {"family": self.family})

    def settings(self, out: Path) -> Settings:
        """Return the settings of the training."""
        from lang3dxl_ns.commands.train import Train
        from lang3dxl_ns.preparation.settings import PreparationConfig

        steps = self.steps or (250 if self.quick else 1_200)
        words = shlex.split(self.train)
        usual = Train.usual(
            words,
            data=out / "scene",
            out=out,
            steps=steps,
            clip=self.clip,
            dense=self.dense,
            photo_scale=0.5,  # words are scored at half the size
            foreground="none",  # score every pixel, also of sky and people
            dense_tokens=32 if self.quick else PreparationConfig.dense_tokens,
        )
        settings = tyro.cli(Train, args=words, default=usual).settings()
        if self.quick:
            settings.scene.decoder.compression.steps = 300
        settings = settings.resolved()
        return settings

    def _report(self, splits: dict[str, list[EvaluatedPhoto]], scene: Scene) -> dict[str, Any]:
        from lang3dxl_ns.evaluation.aggregate import average

        return {
            "command": command_line("lang3dxl demo", self),
            "machine": describe_machine(scene.device),
            "gaussians": len(scene.splats),
            "splits": {
                name: average([photo.metrics for photo in photos]) | {"protocol": {"photos": len(photos)}}
                for name, photos in splits.items()
            },
        }

    def markdown(self, report: dict[str, Any]) -> str:
        """Write the report in markdown."""
        from lang3dxl_ns.evaluation.aggregate import scene_table

        splits = "\n".join(f"#{scene_table(*split)}" for split in report["splits"].items())
        seconds, memory = report["seconds"], report["peak_mb"]
        cost = [[stage, f"{spent:.0f}", f"{memory[stage]:.0f}"] for stage, spent in seconds.items()]
        cost.append(["all", f"{sum(seconds.values()):.0f}", ""])
        return f"""# A landmark and its words

    {report["command"]}

{report["machine"]}. {report["gaussians"]} Gaussians.

Average precision of words, by prompt. The teacher is the crop pyramid's relevancy in the very picture that is
scored, which the field has never seen; the limit is the exact labels, lifted to the Gaussians and
rendered back; chance is a map without information. Blurred maps are blurred by 2.5 pixels at half the photo's
size, as published. Test views are novel cameras in plain light, no people. PSNR is in dB; of features,
"of mean" is the same figure for the mean feature instead.

{splits}
## Cost

{markdown_table(["stage", "seconds", "peak memory (MB)"], cost)}
"""


_BOUNDS = {"seed": (0, 2**63), "photos": (4, 9999), "steps": (1, 1e9), "test_views": (0, 9999)}

_SHARES = {"scene": 0.12, "prepare": 0.24, "train": 0.28, "words": 0.08, "evaluate": 0.28}
"""Stages of the demo, with their usual shares of its time on a CPU."""


def _scored_matches(scene: Scene, evaluation: Evaluation, photos: list[str]) -> dict[str, dict[str, Match]]:
    """Find every scored prompt in the views of some photos as a user would, by photo and prompt. Without
    words or ground truth there are no matches."""
    from lang3dxl_ns.query.text import Prompt

    scorer = evaluation.scorer
    if scorer is None:
        return {photo: {} for photo in photos}
    prompts, scene.encode_texts = scorer.truth.categories, scorer.encode_texts
    question = scene.ask([Prompt(text) for text in prompts])
    return {photo: dict(zip(prompts, scene.matches(question, photo), strict=True)) for photo in photos}


def _picture_row(photo: EvaluatedPhoto, evaluation: Evaluation, matches: dict[str, Match]) -> PictureRow:
    from lab.landmark.picture import PictureRow

    real, rendered = photo.images["img"].cpu().chunk(2, dim=1)
    scorer, truth = evaluation.scorer, {}
    if scorer is not None:
        size = next(iter(photo.maps.values())).shape
        truth = scorer.truth.masks(photo.name, (size[0], size[1]))
    codes = photo.images.get("bottleneck", rendered)
    truth = {prompt: mask for prompt, mask in truth.items() if mask.any() and prompt in matches}
    pictures = (real.numpy(), rendered.numpy(), codes.cpu().numpy())
    return PictureRow(photo.name, *pictures, matches, truth)
