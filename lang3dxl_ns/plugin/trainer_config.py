"""Settings of a training run, fitted to its length, data and resumed run; opening of finished runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.device import best_device, warn_of_unused_gpu
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import absolute, expanded
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.files.runs import find_config
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.plugin.inert_settings import check_inert
from lang3dxl_ns.plugin.optimizers import RunAdamConfig, RunScheduleConfig, check_rates
from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline, print_user_errors_plainly
from lang3dxl_ns.plugin.run_checkpoint import check_checkpoint, latest_checkpoint
from lang3dxl_ns.plugin.run_settings import load_configs, no_config, read_settings
from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer, RunConfig, requested_checkpoint
from lang3dxl_ns.plugin.viewer_guard import check_viewer
from lang3dxl_ns.preparation.model_files import BUILTIN, check_encoders
from lang3dxl_ns.preparation.needs import read_needs
from lang3dxl_ns.scene.photo_folder import check_data
from lang3dxl_ns.scene.record import SCENE_FILE
from lang3dxl_ns.training.batches import settled
from lang3dxl_ns.training.estimate import check_device


@showing(
    *("data", "max_num_iterations", "output_dir", "experiment_name", "load_dir", "load_checkpoint", "vis"),
    *("steps_per_save", "steps_per_eval_image", "save_only_latest_checkpoint", "max_skipped_steps"),
    *("machine", "viewer", "pipeline"),
)
@dataclass
class Lang3DXLTrainerConfig(RunConfig):
    """Settings of a training run. `--max-num-iterations` alone rescales every schedule."""

    _target: type = field(default_factory=lambda: Lang3DXLTrainer)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore settings from config.yml, and tell the data manager the run's folder, known only here."""
        self.__dict__.update(state)
        if self.timestamp != "{timestamp}":
            self.pipeline.datamanager.run = self.get_base_dir()

    def get_base_dir(self) -> Path:
        """Return the run's folder. This is the folder in which nerfstudio's commands with `--load-config`
        found config.yml, which may be a copy of the run, or the one that the settings name."""
        if self.timestamp != "{timestamp}" and not Path(sys.argv[0]).stem.startswith("ns-train"):
            for path in load_configs(sys.argv[1:]):
                if path.is_file() and path.with_name(SCENE_FILE).is_file():
                    return path.parent.absolute()
        return super().get_base_dir()

    def print_to_terminal(self) -> None:
        """Print where the settings are, which other methods print in full."""
        say(f"Settings: {self.get_base_dir() / 'config.yml'}")

    def set_timestamp(self) -> None:
        """Check the settings, resolve what depends on the run, and make the folder of a new one. nerfstudio
        calls this once, before the configuration is printed and saved."""
        print_user_errors_plainly()
        self.check()
        resumed, fresh = requested_checkpoint(self), self.timestamp == "{timestamp}"
        super().set_timestamp()
        self.fit_to_run()
        own = super().get_checkpoint_dir().absolute()
        goes_on = resumed is not None and resumed.absolute().parent == own
        if not (fresh or goes_on) and any(own.glob("*.ckpt")):
            raise UserError(f"{own} holds an earlier run: resume it with --load-dir, or change --timestamp")
        check_encoders(self.pipeline.datamanager.clip, self.pipeline.datamanager.dense)
        check_device(self.machine.device_type, self.pipeline.model.rasterizer)
        if fresh:
            self._claim_folder()

    def check(self) -> None:
        """Raise UserError for a setting that is out of its range, impossible or without effect."""
        model, data = self.pipeline.model, self.pipeline.datamanager
        check_numbers(self, {"max_num_iterations": (1, 1e9), "max_skipped_steps": (0, 1e9)})
        check_numbers(self.machine, {"seed": (0, 2**32 - 1)}, "--machine.")
        if self.machine.num_devices * self.machine.num_machines > 1:
            raise UserError(
                "training runs on one device: densification changes the number of parameters, which "
                "torch's DistributedDataParallel does not support. Leave --machine.num-devices at 1; several "
                "GPUs can prepare targets (lang3dxl prepare --workers N), or train scenes side by side"
            )
        check_rates(self.optimizers)
        model.check()
        data.check()
        check_data(data.data or self.data)
        if self.is_viewer_enabled():
            check_viewer(self.viewer)
        if data.run is None:  # a run's config.yml contains resolved values
            check_inert(model, data, self.optimizers)

    def _claim_folder(self) -> None:
        """Create a unique folder, even if two runs start in the same second."""
        second, tries = self.timestamp, 1
        while True:
            try:
                return self.get_base_dir().mkdir(parents=True)
            except FileExistsError:
                tries += 1
                self.timestamp = f"{second}-{tries}"

    def get_checkpoint_dir(self) -> Path:
        """Return the folder of the checkpoints, after checking the latest one, since every command that loads
        a run calls this. Raises UserError if that checkpoint is damaged."""
        folder = super().get_checkpoint_dir()
        print_user_errors_plainly()
        warn_of_unused_gpu()
        check_checkpoint(folder)
        return folder

    def fit_to_run(self) -> None:
        """Resolve rates, schedules and presets for this number of iterations. Paths become absolute, so that
        config.yml is complete and can be read from any folder."""
        iterations = self.max_num_iterations
        for group in self.optimizers.values():
            if isinstance(group["optimizer"], RunAdamConfig):
                group["optimizer"] = group["optimizer"].fitted(iterations)
            if isinstance(group["scheduler"], RunScheduleConfig):
                group["scheduler"] = replace(group["scheduler"], total_steps=iterations)
        self.load_dir, self.load_checkpoint = _absolute(self.load_dir), _absolute(self.load_checkpoint)
        if self.load_dir is not None:
            self._follow(self.load_dir.parent)
        elif self.load_checkpoint is not None:
            self._follow(self.load_checkpoint.parents[1])
        self.pipeline.model = self.pipeline.model.fitted(iterations)
        self.steps_per_save = min(self.steps_per_save, max(iterations // 4, 1))
        learned = self.pipeline.model.decoder.learns_from_renderings
        gathered = not learned or self.pipeline.model.codes_from == "photos"
        datamanager = replace(settled(self.pipeline.datamanager, learned, gathered), targets_in_steps=learned)
        self.pipeline.datamanager = datamanager
        for name in ("clip", "dense", "sam", "foreground_model"):
            choice = getattr(datamanager, name)
            if choice not in (BUILTIN, "none", "auto") and expanded(choice).is_dir():
                setattr(datamanager, name, str(_absolute(Path(choice))))
        datamanager.dataparser.data = absolute(datamanager.dataparser.data)
        datamanager.data = _absolute(datamanager.data or self.data)
        self.data, datamanager.cache_dir = datamanager.data, _absolute(datamanager.cache_dir)
        self.pipeline.ground_truth = _absolute(self.pipeline.ground_truth)
        if isinstance(datamanager.dataparser, PhotoCollectionDataParserConfig):
            datamanager.dataparser.held_out = _absolute(datamanager.dataparser.held_out)
        self.output_dir = absolute(self.output_dir)

    def _follow(self, run: Path) -> None:
        """Set each `auto` of a resumed run to what it resolved to when the run began."""
        if not (run / "config.yml").is_file():
            return
        earlier: Any = read_config(run / "config.yml").pipeline
        data, needs = self.pipeline.datamanager, read_needs(run)
        mine, before = self.pipeline.model, earlier.model
        if data.clip == "auto":
            data.clip = earlier.datamanager.clip
        if mine.semantic_field.preset == "auto":
            mine.semantic_field = replace(mine.semantic_field, preset=before.semantic_field.preset)
        if mine.appearance.preset == "auto":
            mine.appearance.preset = before.appearance.preset
        for owner, then, name, component in (
            (mine.appearance, before.appearance, "use", "appearance"),
            (mine, before, "view_dependence", "view dependence"),
            (mine, before, "camera_optimization", "camera optimizer"),
        ):
            choice = getattr(then, name)
            if choice == "auto" and component in needs:
                choice = "on" if needs[component] else "off"
            if getattr(owner, name) == "auto":
                setattr(owner, name, choice)


def read_config(path: Path) -> Lang3DXLTrainerConfig:
    """Read the configuration of a run as `read_settings` does. Raises UserError for a missing or damaged
    file, one of another version or method, and one that requests more."""
    (config,) = read_settings(path, [()])
    if not isinstance(config, TrainerConfig):
        raise no_config(path)
    if not isinstance(config, Lang3DXLTrainerConfig):
        raise UserError(f"{path} is a run of another method: use nerfstudio's own commands, or pass another")
    return config


def open_run(run: str | Path | None) -> tuple[Lang3DXLTrainerConfig, Lang3DXLPipeline, int]:
    """Open a run: return settings, pipeline (in evaluation mode) and iteration of its latest checkpoint. No
    code is executed, while nerfstudio's own `eval_setup` trusts config.yml. run: as for `find_config`. Raises
    UserError for a config.yml that is damaged, requests more than settings, or is of another method; and for
    a checkpoint that is missing, damaged, or does not match the settings."""
    config_path = find_config(run).absolute()
    config = read_config(config_path)
    folder = config_path.parent
    path, state = latest_checkpoint(folder / config.relative_model_dir)
    # The folder may have moved; nerfstudio composes its path from these settings.
    config.output_dir, config.experiment_name, config.method_name = folder.parent, "", ""
    config.timestamp, config.load_dir, config.pipeline.datamanager.run = folder.name, path.parent, folder
    pipeline = config.pipeline.setup(device=best_device(), test_mode="test")
    assert isinstance(pipeline, Lang3DXLPipeline)
    pipeline.eval()
    pipeline.load_pipeline(state["pipeline"], state["step"])
    CONSOLE.log(f"Loaded {path}")
    return config, pipeline, state["step"]


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else absolute(path)
