"""`lang3dxl benchmark ablation`: every part of the method taken away or exchanged, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import active_children
from pathlib import Path

from lang3dxl_ns.baselines.rows import CLIPSEG, FULL, TEACHER, Row, choose_rows
from lang3dxl_ns.benchmarks.ablation_report import write_ablation
from lang3dxl_ns.benchmarks.scored_runs import Run, RunSettings, ScoredRuns, scene_labels
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.report import command_line, progress_bar


@dataclass
class ComparisonSettings:
    """What a comparison of trained variants has to know."""

    scene: tuple[Path, ...]
    """Folders with images/, sparse/0/ and ground_truth/, such as `lang3dxl demo-scene` makes."""
    out: Path
    """Folder for the report and the results of every run."""
    seeds: int = 2
    """Runs of each row on each scene, which differ in their random numbers and the order of the photos."""
    steps: int = 1_200
    """Training iterations of each run."""
    clip: str = "builtin"
    """CLIP: "builtin", a Hugging Face name or a folder."""
    dense: str = "builtin"
    """Dense encoder: the same choices, or "none"."""
    foreground: str = "none"
    """Where photos count, as in `lang3dxl prepare`; "none" everywhere."""
    scale: float = 0.5
    """Size of the training photos against those on disk. Words are scored at half the size."""
    dense_tokens: int = 48
    """Dense features per side of a photo."""
    ns_train: str = ""
    """More flags of `ns-train lang3dxl`, for all rows, in one string: --ns-train="--pipeline.model.…"."""
    workers: int = 1
    """Runs at a time. They slow each other down: where seconds matter, leave it at 1."""

    def run_settings(self, clipseg: str = "") -> RunSettings:
        """The part of it that decides what a run gives."""
        return RunSettings(
            self.steps, self.clip, self.dense, self.foreground, self.scale, self.dense_tokens,
            self.ns_train, clipseg,
        )  # fmt: skip


@dataclass
class Ablation(ComparisonSettings):
    """Train and score the method, the systems that it is compared with, and the method without each of its
    parts, everything else equal.

    A finished run is not made again: the command can be stopped at any moment and given again, also with
    more rows, seeds or scenes. The report is written after every run.
    """

    rows: tuple[str, ...] = ()
    """Rows to make (default: all that differ from the full method)."""
    clipseg: str = "CIDAS/clipseg-rd64-refined"
    """CLIPSeg: a Hugging Face name or a folder. Where it can't be had, its row says "not run here"."""

    def main(self) -> None:
        from lang3dxl_ns.model_config import SHORT_FIELD_RUN

        scenes = scene_labels(self.scene)
        with_regions = any((scene / "regions").is_dir() for scene in scenes.values())
        rows = choose_rows(self.rows, self.steps < SHORT_FIELD_RUN, with_regions)
        store = ScoredRuns(self.out, self.run_settings(self.clipseg))
        runs = [
            Run(row, path, label, seed)
            for seed in range(self.seeds)  # so that every row has one run before any has two
            for label, path in scenes.items()
            for row in rows
            if row.trains or (row.name == CLIPSEG and seed == 0)
        ]
        figures, failed = make_all(
            runs, store, lambda *found: self._write(rows, list(scenes), *found), self.workers
        )
        print(f"Wrote {self.out / 'ablation.md'} ({len(figures)} runs, {len(failed)} not run)")

    def _write(
        self, rows: list[Row], scenes: list[str], figures: dict[Run, dict], failed: dict[Run, str]
    ) -> None:
        figures = figures | teacher_figures(rows, figures)
        write_ablation(
            self.out, command_line("lang3dxl benchmark ablation", self), rows, scenes, figures, failed
        )


def make_all(
    runs: Sequence[Run],
    store: ScoredRuns,
    report: Callable[[Mapping[Run, dict], Mapping[Run, str]], None],
    workers: int = 1,
) -> tuple[dict[Run, dict[str, float]], dict[Run, str]]:
    """Figures of all runs and reasons of those that failed; `report` gets both after each that was made."""
    if workers < 1:
        raise UserError(f"--workers is {workers}: at least one run has to go on at a time")
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
        except KeyboardInterrupt:
            for process in active_children():  # Ctrl-C has reached them, another signal has not
                process.terminate()
            threads.shutdown(cancel_futures=True)
            raise
    return figures, failed


def teacher_figures(rows: list[Row], figures: dict[Run, dict]) -> dict[Run, dict[str, float]]:
    """The teacher's own scores, which every run of the full method brings along."""
    teacher = next((row for row in rows if row.name == TEACHER), None)
    if teacher is None:
        return {}
    return {
        Run(teacher, run.scene, run.label, 0): {
            name.removeprefix("teacher_"): value
            for name, value in found.items()
            if name.startswith("teacher_")
        }
        for run, found in figures.items()
        if run.row.name == FULL
    }
