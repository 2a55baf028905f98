"""`lang3dxl benchmark ablation`: the method, other systems, and the method without each of its parts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import active_children
from pathlib import Path
from typing import TypeVar

from lab.benchmarks.ablation_report import write_ablation
from lab.benchmarks.ablation_rows import BOUNDS, FULL, IN_PICTURES, Row, choose_rows
from lab.benchmarks.landmarks import Landmarks, landmark_scenes
from lab.benchmarks.scored_runs import Run, RunSettings, ScoredRuns, scene_labels
from lab.reports import command_line
from lang3dxl_ns.common.console import progress
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing

Found = TypeVar("Found")


@showing("out", "scene", "rows", "seeds", "steps")
@dataclass
class Ablation:
    """Train and score the method, the baselines, and the method without each of its parts, all else equal.

    Finished runs are kept, so the command can be interrupted and repeated at any time, also with more rows,
    lengths, seeds or scenes. The report is updated after every run.
    """

    out: Path
    """Folder for the report and the results of every run."""
    scene: tuple[Path, ...] = ()
    """Folders with images/, sparse/0/ and ground_truth/ (default: the landmarks)."""
    landmarks: Landmarks = "validation"
    """Landmarks, unless scenes are given: validation (six, for decisions) or test (nine, for publication)."""
    photos: int = 48
    """Number of photos of each landmark."""
    test_views: int = 24
    """Number of novel views of each landmark, with exact labels, which give the main score."""
    rows: tuple[str, ...] = ()
    """Rows to run; "systems" compares decoders (default: all but the paper's method and duplicates)."""
    steps: tuple[int, ...] = (1_200,)
    """Training iterations; several lengths show quality against time."""
    seeds: int = 1
    """Number of runs of each row on each scene, with different random numbers and photo orders. All runs of a
    seed are made before any of the next."""
    clip: str = "builtin"
    """CLIP to use: "builtin", a Hugging Face name or a folder."""
    dense: str = "auto"
    """Dense encoder: "auto", "builtin", a Hugging Face name, a folder or "none"."""
    foreground: str = "none"
    """Foreground, with the choices of `lang3dxl prepare`; "none" uses the whole photo."""
    scale: float = 0.5
    """Size of the training photos relative to those on disk. Words are scored at half the size."""
    ns_train: str = ""
    """Extra flags of `ns-train lang3dxl` for all rows, in one string: --ns-train="--pipeline.model.…"."""
    clipseg: str = "CIDAS/clipseg-rd64-refined"
    """CLIPSeg: a Hugging Face name or a folder. If unavailable, its row says "not run here"."""
    langsam: tuple[str, str] = ("IDEA-Research/grounding-dino-tiny", "facebook/sam-vit-base")
    """LangSAM's GroundingDINO and SAM: names or folders. If unavailable, its row says "not run here"."""
    sam3: str = "facebook/sam3"
    """SAM 3: a name or a folder. If unavailable, its row says "not run here". It is gated: accept its license
    at Hugging Face, then run `hf auth login`."""
    workers: int = 1
    """Number of concurrent runs. They slow each other down, so keep 1 if times matter."""

    def main(self) -> None:
        from lang3dxl_ns.training.settings import SHORT_FIELD_RUN

        made = self.scene or landmark_scenes(
            self.landmarks, self.out / "scenes", self.photos, self.test_views
        )
        scenes = scene_labels(made)
        with_regions = any((scene / "regions").is_dir() for scene in scenes.values())
        rows = choose_rows(self.rows, min(self.steps) < SHORT_FIELD_RUN, with_regions)
        settings = RunSettings(
            self.clip,
            self.dense,
            self.foreground,
            self.scale,
            self.ns_train,
            self.clipseg,
            self.langsam,
            self.sam3,
        )
        figures, failed = make_all(
            self.runs(scenes, rows),
            ScoredRuns(self.out, settings),
            lambda *found: self._write(rows, *found),
            self.workers,
        )
        print(f"Wrote {self.out / 'ablation.md'} ({len(figures)} runs, {len(failed)} not run)")

    def runs(self, scenes: Mapping[str, Path], rows: Sequence[Row]) -> list[Run]:
        """List the runs in the order in which they are made. The seed is the outer loop, so an interrupted
        comparison has one run of every row on every scene before any has two.

        Args:
            scenes: Folder of each scene, by label.
            rows: Rows to run. Bounds have no runs of their own, and rows without training have one per scene.
        """
        return [
            Run(row, path, label, seed, steps)
            for seed in range(self.seeds)
            for steps in sorted(self.steps)
            for label, path in scenes.items()
            for row in rows
            if row.trains or (row.name in IN_PICTURES and seed == 0 and steps == min(self.steps))
        ]

    def _write(self, rows: list[Row], figures: dict[Run, dict], failed: dict[Run, str]) -> None:
        command = command_line("lang3dxl benchmark ablation", self)
        figures = self._at_all_lengths(figures | bound_figures(rows, figures))
        write_ablation(self.out, command, rows, figures, self._at_all_lengths(failed))

    def _at_all_lengths(self, found: dict[Run, Found]) -> dict[Run, Found]:
        """Repeat at all lengths the results of rows without training, which run once per scene."""
        return {
            replace(run, steps=steps): value
            for run, value in found.items()
            for steps in (self.steps if run.row.name in IN_PICTURES else [run.steps])
        }


def make_all(
    runs: Sequence[Run],
    store: ScoredRuns,
    report: Callable[[Mapping[Run, dict], Mapping[Run, str]], None],
    workers: int = 1,
) -> tuple[dict[Run, dict[str, float]], dict[Run, str]]:
    """Make the missing runs and return all figures and failures. `report` gets both after each run."""
    if workers < 1:
        raise UserError(f"--workers is {workers}: give 1 or more")
    figures = {run: found for run in runs if (found := store.finished(run)) is not None}
    failed: dict[Run, str] = {}
    missing = [run for run in runs if run not in figures]
    report(figures, failed)
    with progress("training", len(missing)) as advance, ThreadPoolExecutor(workers) as threads:
        made: dict[Future, Run] = {threads.submit(store.make, run): run for run in missing}
        try:
            for future in as_completed(made):
                run = made[future]
                try:
                    figures[run] = future.result()
                except UserError as reason:
                    failed[run] = str(reason)
                advance()
                report(figures, failed)
        except (KeyboardInterrupt, SystemExit):
            for process in active_children():  # Ctrl-C reaches them, but other signals do not
                process.terminate()
            threads.shutdown(cancel_futures=True)
            raise
    return figures, failed


def bound_figures(rows: Sequence[Row], figures: Mapping[Run, Mapping[str, float]]) -> dict[Run, dict]:
    """Extract the figures of the bounds (teacher, limit, chance) from runs of the full method. Their
    `teacher_map`, `test_teacher_map` etc. become `map`, `test_map` etc. of the bounds' own rows."""
    found = {}
    for row in (row for row in rows if row.name in BOUNDS):
        for run, values in figures.items():
            if run.row.name == FULL:
                whose = f"{row.name}_"
                own = {name.replace(whose, "", 1): v for name, v in values.items() if whose in name}
                found[Run(row, run.scene, run.label, run.seed, run.steps)] = own
    return found
