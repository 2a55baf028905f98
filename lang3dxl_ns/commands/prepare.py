"""`lang3dxl reconstruct`, `prepare` and `needs`: a scene before its training."""

from __future__ import annotations

import contextlib
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene.capture_settings import CaptureSettings
from lang3dxl_ns.scene.reconstruction import ReconstructionSettings

if TYPE_CHECKING:
    from lang3dxl_ns.training.batches import TrainingData


@showing("data", "add", "features")
@dataclass(kw_only=True)
class Reconstruct(ReconstructionSettings):
    """Reconstruct photos: cameras, poses and points, as a COLMAP model.

    Training does this itself for photos without a model; this command does it in advance. It can be
    interrupted and repeated at any time, and never replaces an existing model, except by one with photos
    added, of which the old form is kept.
    """

    data: Path
    """Folder of photos (in it, in images/, or in sub-folders), or a video."""
    cache_dir: Path | None = None
    """Folder for features and matches (default: lang3dxl_cache inside the data folder)."""
    add: Path | None = None
    """Folder of new photos, or a video, for the model that the data folder has, whose cameras and points
    stay."""

    def main(self) -> None:
        from lang3dxl_ns.scene.reconstruct import reconstruct_scene

        if self.add is not None:
            from lang3dxl_ns.scene.add_photos import add_photos

            model = add_photos(self.data, self.add, self.cache_dir, self)
            return say(f"The model is in {model}")
        data, model = reconstruct_scene(self.data, self.cache_dir, self)
        words = ["lang3dxl", "train", str(data)]
        words += ["--cache-dir", str(self.cache_dir)] if self.cache_dir else []
        say(f"The model is in {model}. Train with: {shlex.join(words)}")


@showing("data", "clip", "quality", "foreground", "workers", "cache_dir")
@dataclass(kw_only=True)
class Prepare(PreparationConfig, CaptureSettings):
    """Make the targets that training learns from, in advance.

    They are CLIP features of patches (of the built-in CLIP) or of crops, and dense features. Training makes
    missing targets itself. This command can be interrupted and repeated at any time.
    """

    data: Path
    """Folder of photos, or a video."""

    def main(self) -> None:
        from lang3dxl_ns.preparation.model_files import check_encoders
        from lang3dxl_ns.preparation.store import FeatureStore
        from lang3dxl_ns.scene.photo_folder import check_data

        check_data(self.data)
        check_encoders(self.clip, self.dense)
        prepared = _opened(self, self.data)
        if prepared.targets is not None:
            print(f"Targets of {len(prepared.targets.names)} photos are in {prepared.cache_dir}")
        for kind, (files, size) in FeatureStore(prepared.cache_dir).sizes().items():
            print(f"  {kind}: {files} files, {size / 1e6:.1f} MB")


@showing("data", "clip")
@dataclass(kw_only=True)
class Needs(PreparationConfig, CaptureSettings):
    """Measure a scene's needs without training: which optional components will be built, and why.

    Training measures the same, and applies it to every component left at "auto".
    """

    data: Path
    """Folder of photos, or a video."""

    def main(self) -> None:
        from lang3dxl_ns.preparation.needs import needs_table

        # Keep nerfstudio's start-up output out of the answer.
        with contextlib.redirect_stdout(sys.stderr):
            table = needs_table(_opened(self, self.data).needs)
        print(table)


def _opened(settings: Prepare | Needs, data: Path) -> TrainingData:
    """Open a folder of photos with these settings. Nothing is prepared yet."""
    from lang3dxl_ns.common.device import best_device
    from lang3dxl_ns.scene.capture import open_capture, say_left_out
    from lang3dxl_ns.scene.companions import cache_folder
    from lang3dxl_ns.training.batches import TrainingData, settled

    settings.check()
    capture = open_capture(data, settings, settings.cache_dir)
    say_left_out(capture)
    learned = settings.crops == "pyramid" or settings.regions not in ("auto", "none")
    targets = settled(settings, learned, gathered=not learned)
    cache = cache_folder(capture.folder, settings.cache_dir)
    return TrainingData(capture, targets, cache, best_device(), learned)
