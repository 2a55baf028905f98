"""Settings of the data manager: where photos, cameras and targets come from, and how they are cached."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.plugin.datamanager import Lang3DXLDataManager
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.plugin.inert_settings import OF_IMAGE_CACHES, without
from lang3dxl_ns.preparation.encoders import BUILTIN
from lang3dxl_ns.preparation.settings import DENSE_MODEL, PreparationConfig


@without(*OF_IMAGE_CACHES)
@dataclass
class Lang3DXLDataManagerConfig(PreparationConfig, FullImageDatamanagerConfig):
    """Photos and their targets. `--pipeline.datamanager.clip none` trains colors only."""

    _target: type = field(default_factory=lambda: Lang3DXLDataManager)
    dataparser: AnnotatedDataParserUnion = field(default_factory=PhotoCollectionDataParserConfig)
    """Source of photos and cameras."""
    cache_dir: Path | None = None
    """Folder of prepared targets (default: lang3dxl_cache inside the data folder)."""
    cache_gb: float | None = None
    """Memory for decoded photos and their targets, in gigabytes: the first that fit are kept, the others read
    ahead of their use. Default: a quarter of the machine's memory."""
    read_ahead: int = 16
    """Photos read ahead of the training step, in addition to that memory."""
    targets_in_steps: tyro.conf.Suppress[bool] = True
    """Whether training steps learn from the targets; settled with the decoder."""
    run: tyro.conf.Suppress[Path | None] = None
    """Folder of the run whose config.yml this comes from; set when that is read."""

    def check(self) -> None:
        """Raises UserError for invalid options, before any work."""
        super().check()
        check_numbers(self, _BOUNDS, "--pipeline.datamanager.")

    def settle_targets(self, learned: bool) -> None:
        """Regions and targets in every step are for semantics `learned` with the scene; others have finer
        crops."""
        self.targets_in_steps = learned
        if self.crops == "auto":
            self.crops = "pyramid" if learned else "fine"
        if not learned or self.clip == "none":
            self.regions = "none"
        if self.clip == "none":
            self.dense = "none"
        elif self.dense == "auto":
            self.dense = BUILTIN if self.clip == BUILTIN else DENSE_MODEL


_BOUNDS = {"camera_res_scale_factor": (0.001, 8), "cache_gb": (0, 1e6), "read_ahead": (0, 1000)}
