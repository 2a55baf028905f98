"""`python -m lab.benchmarks.real_photos`: train on scenes of real photos and score them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from lab.benchmarks.ablation import make_all
from lab.benchmarks.ablation_rows import CHANCE, FULL, LIMIT, TEACHER, choose_rows
from lab.benchmarks.scored_runs import Run, RunSettings, ScoredRuns
from lab.reports import command_line
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report

COLORS = {
    "half_psnr": "PSNR, half image",
    "psnr": "PSNR",
    "cc_psnr": "PSNR, matched colors",
    "ssim": "SSIM",
    "clip_cosine": "CLIP cosine",
    "gaussians": "Gaussians",
    "setup_seconds": "set-up, CPU s",
    "train_seconds": "training, CPU s",
    "train_peak_mb": "memory, MB",
}
BOUNDS = {TEACHER: "2-D teacher", LIMIT: "limit of the geometry", CHANCE: "chance"}
SPLITS = {"seen_": "photos that training saw", "": "held-out photos"}
"""Prefixes of the words' figures."""


@dataclass
class RealPhotos:
    """Train on real photos by the README's command and score them: colors in held-out photos and, where a
    scene has ground_truth/, words in the masked photos, beside the 2-D teacher.

    Finished runs are kept: the command can be interrupted and repeated at any time. Photos without a COLMAP
    model are reconstructed first.
    """

    scene: tuple[Path, ...]
    """Folders of photos, with ground_truth/ or without."""
    out: Path
    """Folder for real_photos.md and the results of every run."""
    baselines: tuple[str, ...] = ()
    """Baselines to run too, on the scenes with ground truth: rows of `lang3dxl benchmark ablation`."""
    iterations: int = 1_000
    """Training iterations."""
    scale: float = 0.25
    """Size of the training photos relative to those on disk."""
    clip: str = "builtin"
    """CLIP: "builtin", a Hugging Face name or a folder."""
    dense: str = "auto"
    """Dense encoder: the same choices, or "none"."""
    ns_train: str = ""
    """Extra flags of `ns-train lang3dxl` in one string."""

    def main(self) -> None:
        scenes = _labels(self.scene)
        settings = RunSettings(self.clip, self.dense, "auto", self.scale, self.ns_train)
        runs = [
            Run(row, path, label, 0, self.iterations)
            for label, path in scenes.items()
            for row in choose_rows((FULL, *self.baselines), True, False)
            if row.trains and (row.name == FULL or (path / "ground_truth").is_dir())
        ]
        make_all(runs, ScoredRuns(self.out, settings), self._write)

    def _write(self, figures: Mapping[Run, Mapping[str, float]], failed: Mapping[Run, str]) -> None:
        text = [
            "# Real photos",
            f"    {command_line('python -m lab.benchmarks.real_photos', self)}",
            describe_machine(),
            *tables(figures),
            *(f"Not run: {run.name}: {reason}" for run, reason in failed.items()),
        ]
        data = {run.name: dict(found) for run, found in figures.items()}
        write_report(self.out, "real_photos", "\n\n".join(text) + "\n", data)


def tables(figures: Mapping[Run, Mapping[str, float]]) -> list[str]:
    """A table of colors, and for each scene with ground truth one of words, in Markdown."""
    shown = {key: name for key, name in COLORS.items() if any(key in found for found in figures.values())}
    colors = [
        [run.label, run.row.label, *(_figure(found.get(key)) for key in shown)]
        for run, found in figures.items()
    ]
    parts = ["## Held-out photos", markdown_table(["scene", "system", *shown.values()], colors)]
    for label in dict.fromkeys(run.label for run in figures):
        mine = {run: found for run, found in figures.items() if run.label == label}
        for split, photos in SPLITS.items():
            if words := _words(mine, split):
                parts += [f"## Words in {photos} of {label}, average precision", words]
    return parts


def _words(figures: Mapping[Run, Mapping[str, float]], split: str) -> str:
    """Categories by system, and the bounds that the full method records; empty without ground truth."""
    photos = {
        name.removeprefix(f"{split}ap_").removesuffix("_photos"): f"{count:.0f}"
        for found in figures.values()
        for name, count in found.items()
        if name.startswith(f"{split}ap_") and name.endswith("_photos")
    }
    rows: list[Sequence[str]] = []
    for run, values in figures.items():
        kinds = {"": run.row.label} | ({f"{name}_": BOUNDS[name] for name in BOUNDS if run.row.name == FULL})
        for kind, system in kinds.items():
            cells = [values.get(f"{split}{kind}ap_{name}") for name in photos]
            rows.append([system, *map(_figure, cells), _figure(values.get(f"{split}{kind}map"))])
    rows.append(["photos", *photos.values(), ""])
    return markdown_table(["", *photos, "mean"], rows) if photos else ""


def _figure(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2f}"


def _labels(scenes: Sequence[Path]) -> dict[str, Path]:
    """The scenes by the names of their folders. Raises UserError for none, missing ones, and equal names."""
    found: dict[str, Path] = {}
    for scene in (path.expanduser().absolute() for path in scenes):
        if not scene.is_dir():
            raise UserError(f"{scene} is not a folder of photos")
        if scene.name in found:
            raise UserError(f"two scenes are called {scene.name}: rename a folder")
        found[scene.name] = scene
    if not found:
        raise UserError("give --scene one or more folders of photos")
    return found


if __name__ == "__main__":
    tyro.cli(RealPhotos).main()
