"""Runs that are kept: trained on all photos of a scene, scored on the labeled ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from lab.benchmarks.scored_runs import (
    Run,
    RunSettings,
    ScoredRuns,
    in_own_process,
    run_configuration,
    write_output_to,
)
from lang3dxl_ns.common.files import write_atomically


class KeptRuns(ScoredRuns):
    """One scene's run with its scores, in a folder of the scene's name.

    A stopped training goes on at its latest checkpoint; other settings begin anew.
    """

    def __init__(self, folder: Path, settings: RunSettings, truth: Path) -> None:
        super().__init__(folder, settings)
        self.truth = truth

    def kept(self, run: Run) -> Path:
        """The scene's folder: scores.json, scores.md, and the run in runs/."""
        return self.folder / run.label

    def finished(self, run: Run) -> dict[str, float] | None:
        return super().finished(run) if (self.kept(run) / "scores.json").is_file() else None

    def _submit(self, run: Run, log: Path) -> dict[str, float]:
        folder, made_with = self.kept(run), self._made_with(run)
        settings = folder / "made_with.json"
        if not settings.is_file() or json.loads(settings.read_text()) != made_with:
            shutil.rmtree(folder / "runs", ignore_errors=True)
            (folder / "scores.json").unlink(missing_ok=True)
            write_atomically(settings, json.dumps(made_with, indent=1) + "\n")
        return in_own_process(_train_and_keep, run, self.settings, self.truth, folder, log)

    def _path(self, run: Run) -> Path:
        return self.kept(run) / "finished.json"

    def _made_with(self, run: Run) -> dict[str, Any]:
        return super()._made_with(run) | {"ground_truth": str(self.truth), "iterations": run.steps}


def _train_and_keep(
    run: Run, settings: RunSettings, truth: Path, folder: Path, log: Path
) -> dict[str, float]:
    write_output_to(log)
    from lang3dxl_ns.commands.evaluate import write_scores
    from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
    from lang3dxl_ns.plugin.trainer_config import open_run

    config = run_configuration(run, settings, folder)
    config.pipeline.ground_truth, config.pipeline.evaluated_photos = truth.absolute(), "seen"
    parser = config.pipeline.datamanager.dataparser
    assert isinstance(parser, PhotoCollectionDataParserConfig)
    parser.eval_mode = "all"
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    if not trainer.is_finished:
        trainer.train()
    _, pipeline, _ = open_run(config.get_base_dir())
    results = pipeline.evaluation.scored(get_std=True)
    write_scores(folder, run.label, results, pipeline.device)
    return {name: value for name, value in results.items() if isinstance(value, float)}
