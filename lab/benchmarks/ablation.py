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
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import command_line, progress_bar
from lang3dxl_ns.common.settings_help import showing

Found = TypeVar("Found")


@showing("out", "scene", "rows", "seeds", "steps")
@dataclass
class Ablation:
    """Train and score the method, the baselines, and the method without each of its parts, all else equal;
    several lengths show quality against time.

    Finished runs are kept: the command can be interrupted and repeated at any time, also with more rows,
    lengths, seeds or scenes. The report is updated after every run.
    """

    out: Path
    """Folder for the report and the results of every run."""
    scene: tuple[Path, ...] = ()
    """Folders with images/, sparse/0/ and ground_truth/ (default: the landmarks)."""
    landmarks: Landmarks = "validation"
    """Landmarks to use: six for decisions, or the nine of the published figures."""
    photos: int = 48
    """Photos of each landmark."""
    test_views: int = 24
    """Novel views of each landmark, with exact labels; the main score."""
    rows: tuple[str, ...] = ()
    """Rows to run; "systems" for ways to carry features (default: all that differ from the full method)."""
    steps: tuple[int, ...] = (1_200,)
    """Training iterations; several lengths show quality against time."""
    seeds: int = 1
    """Runs of each row on each scene, with different random numbers and photo orders. Every run of a seed is
    made before any of the next."""
    clip: str = "builtin"
    """CLIP: "builtin", a Hugging Face name or a folder."""
    dense: str = "builtin"
    """Dense encoder: the same choices, or "none"."""
    foreground: str = "none"
    """Foreground, as in `lang3dxl prepare`; "none": the whole photo."""
    scale: float = 0.5
    """Size of the training photos relative to those on disk. Words are scored at half the size."""
    ns_train: str = ""
    """Extra flags of `ns-train lang3dxl`, for all rows, in one string: --ns-train="--pipeline.model.…"."""
    clipseg: str = "CIDAS/clipseg-rd64-refined"
    """CLIPSeg: a Hugging Face name or a folder. If unavailable, its row says "not run here"."""
    langsam: tuple[str, str] = ("IDEA-Research/grounding-dino-tiny", "facebook/sam-vit-base")
    """LangSAM's GroundingDINO and SAM, likewise."""
    sam3: str = "facebook/sam3"
    """SAM 3, likewise; gated: accept its license at Hugging Face, then `hf auth login`."""
    workers: int = 1
    """Concurrent runs. They slow each other down: keep 1 where seconds matter."""

    def main(self) -> None:
        from lang3dxl_ns.plugin.model_config import SHORT_FIELD_RUN

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
        """Runs in the order in which they are made. The seed is the outer loop: an interrupted comparison
        has one run of every row on every scene before any has two.

        Args:
            scenes: Folder of each scene, by label.
            rows: Rows to run; bounds have no runs of their own.
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
        """What rows see in the pictures themselves doesn't depend on the training: they run once."""
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
    """Figures of all runs, and reasons of failures; `report` receives both after each run."""
    if workers < 1:
        raise UserError(f"--workers is {workers}: give 1 or more")
    figures = {run: found for run in runs if (found := store.finished(run)) is not None}
    failed: dict[Run, str] = {}
    missing = [run for run in runs if run not in figures]
    report(figures, failed)
    with progress_bar() as bar, ThreadPoolExecutor(workers) as threads:
        task = bar.add_task("training", total=len(missing))
        made: dict[Future, Run] = {threads.submit(store.make, run): run for run in missing}
        try:
            for future in as_completed(made):
                run = made[future]
                try:
                    figures[run] = future.result()
                except UserError as reason:
                    failed[run] = str(reason)
                bar.update(task, advance=1, description=run.name)
                report(figures, failed)
        except (KeyboardInterrupt, SystemExit):
            for process in active_children():  # Ctrl-C has reached them; other signals have not
                process.terminate()
            threads.shutdown(cancel_futures=True)
            raise
    return figures, failed


def bound_figures(rows: Sequence[Row], figures: Mapping[Run, Mapping[str, float]]) -> dict[Run, dict]:
    """Figures of teacher, limit and chance, which every run of the full method records as
    `teacher_map`, `test_teacher_map` etc.: here they become `map`, `test_map` etc. of their own rows."""
    found = {}
    for row in (row for row in rows if row.name in BOUNDS):
        for run, values in figures.items():
            if run.row.name == FULL:
                whose = f"{row.name}_"
                own = {name.replace(whose, "", 1): v for name, v in values.items() if whose in name}
                found[Run(row, run.scene, run.label, run.seed, run.steps)] = own
    return found
