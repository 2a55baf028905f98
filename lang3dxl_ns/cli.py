"""The `lang3dxl` command: everything that is not training, rendering or viewing (those are ns-* commands)."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from lang3dxl_ns.benchmarks.ablation import Ablation
from lang3dxl_ns.benchmarks.error_vs_time import ErrorVsTime
from lang3dxl_ns.benchmarks.lookup import LookupBenchmark
from lang3dxl_ns.benchmarks.rasterizer import RasterizerBenchmark
from lang3dxl_ns.benchmarks.scale import ScaleBenchmark
from lang3dxl_ns.benchmarks.training import TrainingBenchmark
from lang3dxl_ns.commands.demo import Demo
from lang3dxl_ns.commands.doctor import Doctor
from lang3dxl_ns.commands.evaluate import Evaluate
from lang3dxl_ns.commands.query import Export, Query
from lang3dxl_ns.commands.view import View
from lang3dxl_ns.demo.scene_writer import DemoScene
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.numerics.command import Numerics
from lang3dxl_ns.preparation.prepare import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.presets import Preset

if TYPE_CHECKING:
    from lang3dxl_ns.datamanager import Lang3DXLDataManager


@dataclass(kw_only=True)
class Prepare(PreparationConfig):
    """Make the targets that training learns from: CLIP features of crops in physical scale, dense features.

    `ns-train lang3dxl` does this by itself where it is missing; this command does it ahead of time. It can
    be stopped and started again at any moment.
    """

    data: Path
    """Folder with images/ and sparse/0/."""
    cache_dir: Path | None = None
    """Where to keep the targets (default: lang3dxl_cache inside the data folder)."""
    clean: bool = False
    """Make nothing; delete what these settings and the scene's photos do not use (such as the targets of
    photos that are gone, or dense features with --dense none)."""

    def main(self) -> None:
        datamanager = _datamanager(self, self.data, self.cache_dir)
        if self.clean:
            files, freed = datamanager.clean_store()
            print(f"Deleted {files} files, {freed / 1e6:.1f} MB, from {datamanager.cache_dir}")
        elif datamanager.targets is not None:
            print(f"Targets of {len(datamanager.targets.names)} photos are in {datamanager.cache_dir}")
        for kind, (files, size) in FeatureStore(datamanager.cache_dir).sizes().items():
            print(f"  {kind}: {files} files, {size / 1e6:.1f} MB")


@dataclass(kw_only=True)
class Needs(PreparationConfig):
    """Measure what a scene needs, without training: which optional components will be built, and why.

    `ns-train lang3dxl` measures the same and goes by it wherever a component is left on "auto".
    """

    data: Path
    """Folder with images/ and sparse/0/."""
    json: bool = False
    """Print JSON instead of a table."""

    def main(self) -> None:
        import json

        from lang3dxl_ns.scene_needs import as_data, needs_table

        # What nerfstudio says while it loads is not part of the answer.
        with contextlib.redirect_stdout(sys.stderr):
            needs = _datamanager(self, self.data, None).needs
        print(json.dumps(as_data(needs), indent=2) if self.json else needs_table(needs))


def _datamanager(settings: PreparationConfig, data: Path, cache_dir: Path | None) -> Lang3DXLDataManager:
    """The data manager of a folder of photos, as these settings would prepare it; prepares nothing yet."""
    from lang3dxl_ns.datamanager import Lang3DXLDataManagerConfig
    from lang3dxl_ns.dataparser import PhotoCollectionDataParserConfig
    from lang3dxl_ns.methods import DEVICE

    config = Lang3DXLDataManagerConfig(
        dataparser=PhotoCollectionDataParserConfig(data=data),
        data=data,
        cache_dir=cache_dir,
        **{f.name: getattr(settings, f.name) for f in fields(PreparationConfig)},
    )
    return config.setup(device=DEVICE, test_mode="test")


Benchmark = (
    Annotated[RasterizerBenchmark, tyro.conf.subcommand("rasterizer")]
    | Annotated[TrainingBenchmark, tyro.conf.subcommand("training")]
    | Annotated[ScaleBenchmark, tyro.conf.subcommand("scale")]
    | Annotated[LookupBenchmark, tyro.conf.subcommand("lookup")]
    | Annotated[Ablation, tyro.conf.subcommand("ablation")]
    | Annotated[ErrorVsTime, tyro.conf.subcommand("error-vs-time")]
)
Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Prepare, tyro.conf.subcommand("prepare")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Needs, tyro.conf.subcommand("needs")]
    | Annotated[Query, tyro.conf.subcommand("query")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[DemoScene, tyro.conf.subcommand("demo-scene")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate", description="Score words against ground truth.")]
    | Annotated[Preset, tyro.conf.subcommand("preset")]
    | Annotated[Numerics, tyro.conf.subcommand("numerics")]
    | Annotated[
        Benchmark,
        tyro.conf.subcommand("benchmark", description="Measure: time, memory and error, side by side."),
    ]
)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the `lang3dxl` command."""
    try:
        with _terminable():
            tyro.cli(Command, args=arguments, description=__doc__, config=(tyro.conf.OmitArgPrefixes,)).main()
    except UserError as error:
        sys.exit(f"Error: {error}")
    except KeyboardInterrupt:
        print("\nStopped; what was finished is kept.", file=sys.stderr)
        sys.exit(130)


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let a SIGTERM stop the command as Ctrl-C does: tidily, instead of on the spot."""
    if threading.current_thread() is not threading.main_thread():  # only that one may handle signals
        yield
        return
    import numpy  # noqa: F401 (before pycolmap, see demo/crowd.py)
    import pycolmap  # noqa: F401 (as it loads, it makes SIGTERM print a stack trace and kill: ours comes after)

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


if __name__ == "__main__":
    main()
