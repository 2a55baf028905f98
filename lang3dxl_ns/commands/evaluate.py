"""`lang3dxl evaluate`: scoring of runs, of other systems' maps, and of several scenes together."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from lang3dxl_ns.commands.of_scene import OfScene
from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import read_names, write_atomically
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.evaluation.aggregate import average, pool, pooled_table, read_results, scene_table
from lang3dxl_ns.evaluation.ground_truth import GroundTruth, Layout, held_out_photos

REPORT, THINGS = "scores", "thing_scores"
"""Names of the report's files, without suffix, and of that on things: `lang3dxl things` has a things.json."""
_DRAWN = "draw objects white on black, or black on white for --layout holyscenes"


@dataclass(kw_only=True)
class _Scored:
    layout: Layout | Literal["auto"] = "auto"
    """Layout of the ground truth; "auto" detects it."""
    scene: str | None = None
    """Name in the report (default: the name of the folder of the data, or of the ground truth)."""
    out: Path
    """Folder for the report."""


@showing("maps", "ground_truth", "out")
@dataclass(kw_only=True)
class EvaluateMaps(_Scored):
    """Score relevancy maps made by any system, and write scores.md and scores.json. Maps are in a folder per
    prompt, as `<prompt>/<photo>.npy` (float) or a picture. `lang3dxl query` also writes them so."""

    maps: Path
    """Folder of the maps."""
    ground_truth: Path
    """Folder of the scene's ground truth, in any layout of docs/evaluation.md."""
    photos: Path | None = None
    """Text file with the names of the photos to score, one per line (default: all labeled photos)."""
    masks: Path | None = None
    """Folder of foreground masks, white = keep. Predictions become 0 elsewhere."""
    temperature: float = 1.0
    """Softmax temperature that the maps were made with: 20 for `lang3dxl query`, 10 in LERF's code. For the
    published processing, maps are converted to temperature 1, which it uses."""

    def main(self) -> None:
        from lang3dxl_ns.evaluation.predictions import score_predictions

        if not self.temperature > 0:
            raise UserError(f"--temperature is {self.temperature}: give a number above 0")
        truth = GroundTruth(self.ground_truth, self.layout)
        names = None if self.photos is None else read_names(self.photos, known=truth.labeled)
        photos, protocol = score_predictions(truth, self.maps, names, self.masks, self.temperature)
        results = average(list(photos.values()), with_deviation=True)
        results |= {"protocol": protocol, "photos": photos}
        folder = truth.folder.absolute()
        name = folder.parent.name if folder.name in ("ground_truth", "label") else folder.name
        write_scores(self.out, self.scene or name, results)


@showing("run", "split", "ground_truth", "out")
@dataclass(kw_only=True)
class EvaluateRun(_Scored):
    """Score a trained run like `ns-eval`, but on photos and with ground truth of your choice. Writes
    scores.md and scores.json."""

    run: tyro.conf.Positional[Path | None] = None
    """Folder of the run, or its config.yml (default: the newest run under outputs/). Of a .scene file, and of
    a run of lang3dxl train, words are scored with --ground-truth, without the photos."""
    split: Literal["held-out", "seen"] = "held-out"
    """Photos to score: those held out of training, or labeled training photos."""
    ground_truth: Path | None = None
    """Folder of ground truth (default: the run's setting, or the one beside its data)."""
    clip: str | None = None
    """Name or folder of the scene's CLIP, if it is not where the scene file says."""

    def main(self) -> None:
        from lang3dxl_ns.files.runs import find_config, find_run

        if self.ground_truth is not None:
            GroundTruth(self.ground_truth, self.layout)  # fail now rather than after loading
        place = find_run(self.run)
        if place.suffix != ".yml" and not (place / "config.yml").is_file():
            return self._score_scene(place)
        if self.clip is not None:
            raise UserError("--clip is for scene files: leave it off, or name the .scene file of the run")
        from lang3dxl_ns.plugin.trainer_config import open_run

        _, pipeline, _ = open_run(place)
        pipeline.config.evaluated_photos = self.split
        if self.ground_truth is not None:
            pipeline.config.ground_truth = self.ground_truth
        if self.ground_truth is not None or self.layout != "auto":
            pipeline.config.ground_truth_layout = self.layout
        results = pipeline.evaluation.scored(get_std=True)
        if taught := _taught_beside(find_config(place).parent):
            results["protocol"]["taught_words_left_out"] = taught
            words = ", ".join(taught)
            say(f"Scored by text alone: what examples taught ({words}) counts where the .scene file is named")
        scene = self.scene or pipeline.datamanager.data.capture.folder.name
        write_scores(self.out, scene, results, pipeline.device)

    def _score_scene(self, place: Path) -> None:
        from lang3dxl_ns.evaluation.score_scene import labeled_photos, score_scene, score_selections
        from lang3dxl_ns.open_scene import existing_scene_file, load_scene

        file = existing_scene_file(place)
        if self.ground_truth is None:
            raise UserError(f"{file} is scored with --ground-truth FOLDER, --split held-out or seen")
        truth = GroundTruth(self.ground_truth, self.layout)
        scene = load_scene(file, clip=self.clip)
        photos, protocol = score_scene(scene, truth, self.split)
        results = average(list(photos.values()), with_deviation=True)
        results |= score_selections(scene, truth, labeled_photos(scene, truth, self.split))
        write_scores(self.out, self.scene or file.stem, results | {"protocol": protocol, "photos": photos})


@showing("scene", "coco", "out")
@dataclass(kw_only=True)
class EvaluateThings(OfScene):
    """Score single things against the boxes of labels, and write thing_scores.md and thing_scores.json."""

    coco: Path
    """COCO instances, or a folder of LERF-OVS labels: boxes in photos; their categories are the words."""
    out: Path
    """Folder for the report."""

    def main(self) -> None:
        from lang3dxl_ns.evaluation.score_things import score_things
        from lang3dxl_ns.open_scene import load_scene

        scores = score_things(load_scene(self.scene, clip=self.clip), self.coco)
        table = markdown_table(["word", "there", "found", "false", "F1"], scores)
        write_report(self.out, THINGS, table, {"scores": scores})
        print(f"{table}\n\nWrote {self.out / THINGS}.md")


@showing("reports", "out")
@dataclass(kw_only=True)
class EvaluatePool:
    """Combine scenes: average over all photos, and over the scenes' means. Writes scores.md and
    scores.json."""

    reports: list[Path]
    """The scores.json of each scene from `lang3dxl evaluate`, or its file from `ns-eval --output-path`."""
    out: Path
    """Folder for the report."""

    def main(self) -> None:
        if not self.reports:
            raise UserError("there is nothing to combine: name the scenes' reports after --reports")
        scenes: dict[str, dict[str, Any]] = {}
        for path in self.reports:
            name, results = read_results(path)
            if name in scenes:
                raise UserError(
                    f"{path} is a second report of the scene {name}: give one for each scene; two "
                    f"scenes of one name are told apart by lang3dxl evaluate run … --scene NAME"
                )
            scenes[name] = results
            if path.resolve() == (self.out / f"{REPORT}.json").resolve():
                raise UserError(f"{path} would be written over: name another folder after --out")
        protocols = {name: results["protocol"] for name, results in scenes.items()}
        for key in ("layout", "scored_at"):
            if len({str(protocol.get(key)) for protocol in protocols.values()}) > 1:
                raise UserError(f"the scenes differ in {key}: {', '.join(scenes)} can't be combined")
        if not any("map" in results for results in scenes.values()):
            raise UserError(f"no prompt was scored in {', '.join(scenes)}: there is nothing to combine")
        pooled = pool({name: list(results["photos"].values()) for name, results in scenes.items()})
        table = "\n".join([pooled_table(pooled), "", *(_told(*scene) for scene in protocols.items())])
        write_report(self.out, REPORT, table, pooled | {"protocols": protocols})
        print(f"{table}\n\nWrote {self.out / REPORT}.md")


@showing("ground_truth", "out")
@dataclass(kw_only=True)
class EvaluateSplit:
    """Choose labeled photos to hold out of training, up to five that show each category, always the same.
    Pass the list to `lang3dxl train FOLDER --held-out FILE`."""

    ground_truth: Path
    """Folder of the scene's ground truth."""
    out: Path
    """Text file to write."""

    def main(self) -> None:
        names = held_out_photos(GroundTruth(self.ground_truth))
        if not names:
            raise UserError(f"no label in {self.ground_truth} marks a pixel; {_DRAWN}")
        if cut := [name for name in names if " #" in f" {name}"]:
            raise UserError(
                f"in a list, # begins a comment: rename these labels and their photos: {some(cut)}"
            )
        write_atomically(self.out, "\n".join(names) + "\n")
        print(f"Wrote {len(names)} names to {self.out}")


Evaluate = (
    Annotated[EvaluateMaps, tyro.conf.subcommand("maps")]
    | Annotated[EvaluateRun, tyro.conf.subcommand("run")]
    | Annotated[EvaluateThings, tyro.conf.subcommand("things")]
    | Annotated[EvaluatePool, tyro.conf.subcommand("pool")]
    | Annotated[EvaluateSplit, tyro.conf.subcommand("split")]
)


def _taught_beside(run: Path) -> list[str]:
    """List the words that the scene files in a run's folder were taught."""
    from lang3dxl_ns.files.runs import scenes_in
    from lang3dxl_ns.files.scene_file import describe_scene_file

    taught: list[str] = []
    for file in scenes_in(run):
        with suppress(UserError):  # a damaged one has no say in the run's figures
            taught += [word.name for word in describe_scene_file(file)["taught"]]
    return taught


def _told(name: str, protocol: dict[str, Any]) -> str:
    """Summarize what a report says about how its scene was scored."""
    keys = ("evaluated_photos", "seen_in_training", "foreground")
    known = [f"{key.replace('_', ' ')}: {protocol[key]}" for key in keys if protocol.get(key) is not None]
    return f"- {name}: {', '.join(known) or 'its report does not tell how it was scored'}"


def write_scores(folder: Path, scene: str, results: dict[str, Any], device: Any = "cpu") -> None:
    """Write a scene's report, scores.json and scores.md, and print it."""
    report = {"scene": scene, "machine": describe_machine(device), "results": results}
    table = scene_table(scene, results)
    write_report(folder, REPORT, table, report)
    print(table)
    print(f"\nWrote {folder / REPORT}.md")
    if "map" not in results and (empty := results["protocol"].get("photos_without_positives")):
        raise UserError(f"no word was scored: no label marks a pixel of {some(list(empty))}; {_DRAWN}")
