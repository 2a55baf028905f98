"""Trainer: run-relative schedules, exact resume, step guard."""

from __future__ import annotations

import math
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch import Tensor
from torch.cuda.amp.grad_scaler import GradScaler
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.device import unused_gpu, warn_of_unused_gpu
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.memory import ran_out_of_memory
from lang3dxl_ns.components import schedules
from lang3dxl_ns.plugin.checkpoint import restore_run_state, run_state
from lang3dxl_ns.plugin.datamanager import PhotosGoneError
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.plugin.load_scene import (
    NOT_A_CHECKPOINT,
    check_checkpoint,
    describe_scene,
    read_checkpoint,
)
from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline, Lang3DXLPipelineConfig, print_user_errors_plainly
from lang3dxl_ns.plugin.saved_config import read_config
from lang3dxl_ns.plugin.sizes import plan, sizes_of
from lang3dxl_ns.plugin.step_guard import StepGuard
from lang3dxl_ns.preparation.encoders import check_encoders
from lang3dxl_ns.preparation.needs import read_needs, write_needs
from lang3dxl_ns.query.run_file import SCENE_FILE
from lang3dxl_ns.rendering import gsplat_build

SHORT_RUN = 1_000
"""Iterations of a run that uses the short-run rates."""
LONG_RUN = 30_000
"""Iterations of a run that uses the published rates."""


def run_length_weight(iterations: int) -> float:
    """Position of a run between the short (0) and the long one (1), on a logarithmic scale."""
    position = math.log(max(iterations, 1) / SHORT_RUN) / math.log(LONG_RUN / SHORT_RUN)
    return min(max(position, 0.0), 1.0)


@dataclass
class RunAdamConfig(AdamOptimizerConfig):
    """Adam with a learning rate for the length of the run."""

    eps: float = 1e-15
    """As in 3D Gaussian splatting: the first gradients of codes and tables are tiny."""
    short_lr: float | None = None
    """Rate for runs of up to 1,000 iterations (None: the same as `lr`, which is for 30,000 and more).
    In between, the two are interpolated on a logarithmic scale."""

    def fit(self, iterations: int) -> None:
        """Resolve `lr` for a run of this many iterations."""
        if self.short_lr is not None:
            self.lr = schedules.log_linear(run_length_weight(iterations), self.short_lr, self.lr)
            self.short_lr = None

    def setup(self, params) -> Optimizer:
        return torch.optim.Adam(params, lr=self.lr, eps=self.eps, weight_decay=self.weight_decay)


@dataclass
class RunScheduleConfig(SchedulerConfig):
    """A learning-rate curve in fractions of the run: warm-up (log-linear), then decay."""

    _target: type = field(default_factory=lambda: RunSchedule)
    start: float = 1.0
    """Multiple of the rate at the first iteration."""
    warm: float = 0.0
    """Fraction of the run until the full rate."""
    end: float = 1.0
    """Multiple of the rate at the end."""
    shape: Literal["cosine", "log-linear"] = "cosine"
    """Shape of the decay after the warm-up."""
    power: float = 1.0
    """Cosine only: the fraction is first raised to this power (2 keeps the rate high longer)."""
    until: float = 1.0
    """Fraction of the run at which the end is reached; constant afterwards."""
    total_steps: int = LONG_RUN
    """Iterations of the run; set by the trainer."""


class RunSchedule(Scheduler):
    """Makes the scheduler of a `RunScheduleConfig`."""

    config: RunScheduleConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        # A plain function, since LambdaLR would put a callable object's state into the checkpoint.
        return LambdaLR(optimizer, lambda step: self.multiple(step))

    def multiple(self, step: int) -> float:
        """Multiple of the rate at an iteration, as a Python float (a NumPy one would end up in the
        checkpoint, where torch's weights-only loader rejects it)."""
        c = self.config
        x = min(step / max(c.total_steps, 1) / c.until, 1.0)
        if x < c.warm:
            return schedules.log_linear(x / c.warm, c.start, 1.0)
        rest = (x - c.warm) / (1.0 - c.warm) if c.warm < 1.0 else 1.0
        if c.shape == "log-linear":
            return schedules.log_linear(rest, 1.0, c.end)
        return schedules.cosine_decay(rest, 1.0, c.end, c.power)


@dataclass
class Lang3DXLTrainerConfig(TrainerConfig):
    """Training configuration; `--max-num-iterations` alone rescales every schedule."""

    _target: type = field(default_factory=lambda: Lang3DXLTrainer)
    pipeline: Lang3DXLPipelineConfig = field(default_factory=Lang3DXLPipelineConfig)
    max_skipped_steps: int = 20
    """A step whose loss or gradient is not finite is skipped; after this many in a row the run stops."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        """When config.yml is read: tell the data manager the run's folder, which only this class knows."""
        self.__dict__.update(state)
        if self.timestamp != "{timestamp}":
            self.pipeline.datamanager.run = self.get_base_dir()

    def print_to_terminal(self) -> None:
        """Say where the settings are; LANG3DXL_VERBOSE=1 prints all of them, as other methods do."""
        if os.environ.get("LANG3DXL_VERBOSE") == "1":
            super().print_to_terminal()
        else:
            say(f"Settings: {self.get_base_dir() / 'config.yml'} (LANG3DXL_VERBOSE=1 prints them)")

    def set_timestamp(self) -> None:
        """Called once before the configuration is printed and saved: settle what depends on the run, and make
        sure that the encoders can be had before a folder is made for it."""
        print_user_errors_plainly()
        check_numbers(self, {"max_num_iterations": (1, 1e9), "max_skipped_steps": (0, 1e9)})
        if self.pipeline.model.max_gaussians is not None:
            check_numbers(self.pipeline.model, {"max_gaussians": (0, 1e9)}, "--pipeline.model.")
        check_numbers(self.machine, {"seed": (0, 2**32 - 1)}, "--machine.")
        self.pipeline.datamanager.check()
        fresh = self.timestamp == "{timestamp}"
        super().set_timestamp()
        self.fit_to_run()
        data = self.pipeline.datamanager
        check_encoders(data.clip, data.dense)
        self._check_device()
        if fresh:
            self._claim_folder()

    def _check_device(self) -> None:
        """Before anything is prepared: say if a GPU stays unused, and build gsplat if it is needed."""
        if self.machine.device_type == "cuda" and not torch.cuda.is_available():
            raise UserError(f"torch can't use a GPU here: {unused_gpu() or 'there is none'}")
        warn_of_unused_gpu()
        rasterizer = self.pipeline.model.rasterizer
        if self.machine.device_type == "cuda" and rasterizer == "auto":
            gsplat_build.ready()
        elif self.machine.device_type == "cuda" and rasterizer == "gsplat":
            gsplat_build.make_ready()

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
        """Folder of the checkpoints. Every command that loads a run calls this, so it also checks the
        latest one. Raises UserError if that is damaged."""
        folder = super().get_checkpoint_dir()
        print_user_errors_plainly()
        warn_of_unused_gpu()
        check_checkpoint(folder)
        return folder

    def fit_to_run(self) -> None:
        """Resolve rates, schedules and presets for this number of iterations; make paths absolute, so
        that config.yml is complete and can be read from any folder."""
        if self.machine.num_devices * self.machine.num_machines > 1:
            print_user_errors_plainly()
            raise UserError(
                "training runs on one device: densification changes the number of parameters, which "
                "torch's DistributedDataParallel does not support. Leave --machine.num-devices at 1; several "
                "GPUs can prepare targets (lang3dxl prepare --workers N), or train scenes side by side"
            )
        iterations = self.max_num_iterations
        for group in self.optimizers.values():
            if isinstance(group["optimizer"], RunAdamConfig):
                group["optimizer"].fit(iterations)
            if isinstance(group["scheduler"], RunScheduleConfig):
                group["scheduler"].total_steps = iterations
        self.load_dir, self.load_checkpoint = _absolute(self.load_dir), _absolute(self.load_checkpoint)
        if self.load_dir is not None:
            self._follow(self.load_dir.parent)
        elif self.load_checkpoint is not None:
            self._follow(self.load_checkpoint.parents[1])
        self.pipeline.model.fit_to_run(iterations)
        self.steps_per_save = min(self.steps_per_save, max(iterations // 4, 1))
        datamanager = self.pipeline.datamanager
        datamanager.settle_targets(learned=self.pipeline.model.encoder.learns_from_renderings)
        datamanager.data = _absolute(datamanager.data or self.data)
        self.data = datamanager.data
        self.pipeline.ground_truth = _absolute(self.pipeline.ground_truth)
        if isinstance(datamanager.dataparser, PhotoCollectionDataParserConfig):
            datamanager.dataparser.held_out = _absolute(datamanager.dataparser.held_out)
        self.output_dir = Path(self.output_dir).expanduser().absolute()

    def _follow(self, run: Path) -> None:
        """A resumed run keeps what `auto` resolved to when it began."""
        if not (run / "config.yml").is_file():
            return
        earlier: Any = read_config(run / "config.yml").pipeline
        earlier = earlier.model
        needs, mine = read_needs(run), self.pipeline.model
        for part in ("semantic_field", "appearance"):
            if getattr(mine, part).preset == "auto":
                getattr(mine, part).preset = getattr(earlier, part).preset

        def settle(owner: Any, before: Any, name: str, component: str) -> None:
            choice = getattr(before, name)
            if choice == "auto" and component in needs:
                choice = "on" if needs[component] else "off"
            if getattr(owner, name) == "auto":
                setattr(owner, name, choice)

        settle(mine.appearance, earlier.appearance, "use", "appearance")
        settle(mine, earlier, "view_dependence", "view dependence")
        settle(mine, earlier, "camera_optimization", "camera optimizer")


class GuardedOptimizers(Optimizers):
    """nerfstudio's optimizers with a guard before each step."""

    def __init__(self, config: dict, param_groups: dict, allowed: Callable[[GradScaler], bool]):
        super().__init__(config, param_groups)
        self._allowed = allowed

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        """Step, or drop all gradients and leave parameters and moments unchanged."""
        if self._allowed(grad_scaler):
            super().optimizer_scaler_step_some(grad_scaler, param_groups)
            return
        for name, parameters in self.live_parameters().items():
            if any(parameter.grad is not None for parameter in parameters):
                grad_scaler.unscale_(self.optimizers[name])  # records the overflow, which lowers the scale
        self.zero_grad_all()

    def live_parameters(self) -> dict[str, list[Tensor]]:
        """The optimizers' present parameters (`parameters` are the initial ones, before densification)."""
        return {
            name: [parameter for group in optimizer.param_groups for parameter in group["params"]]
            for name, optimizer in self.optimizers.items()
        }


class Lang3DXLTrainer(Trainer):
    """nerfstudio's trainer with atomic checkpoints, a resumed run that ends at the requested iteration, and a
    guard against steps that are not finite."""

    config: Lang3DXLTrainerConfig
    pipeline: Lang3DXLPipeline
    optimizers: GuardedOptimizers
    interrupted = False
    """Whether training was interrupted."""
    _last_iteration = -1
    _is_ending = False
    _run_state: dict[str, Any] | None = None

    def __init__(self, config: Lang3DXLTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        """Mixed precision means bfloat16 where the GPU has it: it has float32's range, so that gradients need
        no scale, and no step is lost or waits for one. Older GPUs (before Ampere) take float16 with a
        scale."""
        super().__init__(config, local_rank, world_size)
        if self.mixed_precision:
            wide = torch.cuda.is_bf16_supported(including_emulation=False)
            torch.set_autocast_dtype("cuda", torch.bfloat16 if wide else torch.float16)
            self.use_grad_scaler = config.use_grad_scaler or not wide
            self.grad_scaler = GradScaler(enabled=self.use_grad_scaler)

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Set up, then seed, so that preparation does not affect the run's randomness. Writes a description
        of the scene into the run's folder, so that it can be queried without the photos."""
        # nerfstudio turns this on, and photos of many sizes would then be tuned for in nearly every step.
        torch.backends.cudnn.benchmark = False
        data, self.config.data = self.config.data, None  # otherwise the viewer would write camera paths there
        try:
            super().setup(test_mode)
        finally:
            self.config.data = data
        for optimizer in self.optimizers.optimizers.values():
            add_rows_to_state(optimizer)
        if self.local_rank == 0:
            describe_scene(self.pipeline.datamanager).write(self.base_dir / SCENE_FILE)
            if test_mode == "val":
                write_needs(self.pipeline.datamanager.needs, self.base_dir)
        self._limit_gaussians()
        torch.manual_seed(self.config.machine.seed)
        if self._run_state is not None:
            restore_run_state(self.pipeline, self._run_state)

    def _limit_gaussians(self) -> None:
        """Set the cap of densification from the device's memory, and log what training will take."""
        model, cameras = self.pipeline.model, self.pipeline.datamanager.train_dataset.cameras
        pixels, looks = int((cameras.width * cameras.height).max()), model.appearance is not None
        device = torch.device(self.device)
        sizes = sizes_of(model, model.gauss_params, looks, pixels, device.type == "cuda")
        now, wanted = model.num_points, self.config.pipeline.model.max_gaussians
        model.strategy.most, message = plan(sizes, device, now, wanted)
        CONSOLE.log(escape(message))

    def _load_checkpoint(self) -> None:
        """As nerfstudio's, but keeps the run state until everything is set up. Raises UserError for
        a damaged checkpoint, or another file."""
        path = self._checkpoint_to_load()
        if path is None:
            return
        check_checkpoint(path)
        state = read_checkpoint(path)
        try:
            self._start_step = state["step"] + 1
            self.pipeline.load_pipeline(state["pipeline"], state["step"])
            self.optimizers.load_optimizers(state["optimizers"])
            if self.config.load_scheduler:
                self.optimizers.load_schedulers(state["schedulers"])
            if state["scalers"]:  # empty in a run without a loss scale
                self.grad_scaler.load_state_dict(state["scalers"])
        except (*NOT_A_CHECKPOINT, AssertionError) as error:
            raise UserError(
                f"{path} is not a checkpoint of lang3dxl ({error}): give --load-dir the "
                "nerfstudio_models folder of a run, or --load-checkpoint one of its step-….ckpt files"
            ) from error
        self._run_state = state.get("run")  # absent from checkpoints of earlier versions
        CONSOLE.log(f"Loaded {path}")

    def _checkpoint_to_load(self) -> Path | None:
        """Raises UserError if a requested checkpoint doesn't exist."""
        folder, path = self.config.load_dir, self.config.load_checkpoint
        if folder is not None:
            step = "*" if self.config.load_step is None else f"{self.config.load_step:09d}"
            path = max(folder.glob(f"step-{step}.ckpt"), default=folder / f"step-{step}.ckpt")
        if path is not None and not path.is_file():
            raise UserError(f"there is no checkpoint {path}: pass the folder nerfstudio_models of a run")
        return path

    @property
    def first_iteration(self) -> int:
        """First iteration: 0, or the one after the loaded checkpoint."""
        return self._start_step

    def setup_optimizers(self) -> Optimizers:
        """The optimizers, with the guard before them."""
        self.guard = StepGuard(self.config.max_skipped_steps, lambda message: CONSOLE.log(escape(message)))
        groups = self.pipeline.get_param_groups()
        return GuardedOptimizers(self.config.optimizers.copy(), groups, self._step_is_sound)

    def _step_is_sound(self, grad_scaler: GradScaler) -> bool:
        scale = grad_scaler.get_scale()
        sound = self.guard.allows(
            self.step,
            self.pipeline.datamanager.photo_in_hand,
            self.pipeline.last_losses,
            self.optimizers.live_parameters(),
            scale,
        )
        # Densification accumulates the gradients of the screen positions, just as broken, and as scaled.
        self.pipeline.model.step_is_sound = sound
        self.pipeline.model.strategy.loss_scale = scale
        return sound

    def train(self) -> None:
        """Train up to `max_num_iterations` in total (nerfstudio would add that many to a resumed run)."""
        total = self.config.max_num_iterations
        if self._start_step >= total:
            raise UserError(
                f"the checkpoint in {self.config.load_dir or self.config.load_checkpoint} already has "
                f"{self._start_step} iterations, and the run has {total}: "
                f"pass --max-num-iterations with a larger number"
            )
        if self._start_step:
            CONSOLE.log(f"Resuming at iteration {self._start_step} of {total}")
        self.config.max_num_iterations = total - self._start_step
        try:
            with self._stoppable():
                super().train()
        except PhotosGoneError as error:
            raise UserError(f"{error}. {self._stop_early()}") from error
        except (RuntimeError, MemoryError) as error:
            if not ran_out_of_memory(error):
                raise
            raise UserError(self._out_of_memory()) from error
        finally:
            self.config.max_num_iterations = total
            if summary := self.guard.summary():
                CONSOLE.log(escape(summary))

    def train_iteration(self, step: int):
        result = super().train_iteration(step)
        self._last_iteration = step
        return result

    @contextmanager
    def _stoppable(self) -> Iterator[None]:
        """Let Ctrl-C or SIGTERM end training after the current iteration, with a checkpoint; a second one
        ends it at once."""

        def stop(number: int, _frame: FrameType | None) -> None:
            self.interrupted = self.stop_training = True
            signal.signal(number, previous[signal.Signals(number)])

        if threading.current_thread() is not threading.main_thread():  # only it may handle signals
            yield
            return
        previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        for number in previous:
            signal.signal(number, stop)
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _stop_early(self) -> str:
        """Save a checkpoint when training can't continue; returns a message about it."""
        self._is_ending = True
        if self._last_iteration < 0:
            return "Nothing was learned yet"
        self.save_checkpoint(self._last_iteration)
        return (
            f"Stopped after {self._last_iteration + 1} iterations with a checkpoint; to resume: the same "
            f"command with --load-dir {self.checkpoint_dir}"
        )

    def _out_of_memory(self) -> str:
        """What happened and what helps. The interrupted step may have left half-made tensors, so the latest
        checkpoint stays as it is."""
        count = self.pipeline.model.num_points
        saved = sorted(self.checkpoint_dir.glob("step-*.ckpt"))
        kept = (
            f"{saved[-1]} is kept: --load-dir {self.checkpoint_dir} resumes there"
            if saved
            else "none is saved yet"
        )
        return (
            f"out of memory at iteration {self.step} with {count:,} Gaussians. Three settings help: "
            f"--pipeline.model.max-gaussians {count // 2}, --pipeline.datamanager.camera-res-scale-factor "
            f"0.5, --pipeline.model.view-dependence off. The latest checkpoint: {kept}"
        )

    def _after_train(self) -> None:
        """Finish and save; after an interruption print how to resume, and don't wait in the viewer."""
        self._is_ending = True
        if not self.interrupted:
            self.pipeline.finish_training()
        if self.interrupted:
            self.step = max(self._last_iteration, self._start_step)  # not the one that was about to begin
            self.config.viewer.quit_on_train_completion = True
            CONSOLE.print(
                f"Stopped after {self.step + 1} iterations. To resume: the same command with "
                f"--load-dir {self.checkpoint_dir}",
                soft_wrap=True,
            )
        super()._after_train()

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Write the checkpoint beside its folder and move it in, so that a killed run leaves no partial one.

        If it can't be written training continues; at its end that is a UserError.
        """
        path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        partial = self.base_dir / f"{path.name}.partial"
        try:
            self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
            self._write_checkpoint(step, partial)
            os.replace(partial, path)
        except (OSError, RuntimeError) as error:  # torch raises the latter for a full disk
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            free = shutil.disk_usage(self.base_dir).free / 1e9 if self.base_dir.is_dir() else 0.0
            message = (
                f"the checkpoint {path} can't be written ({error}; {free:.1f} GB are free): free some space; "
                "earlier checkpoints are kept, and --load-dir resumes from the latest"
            )
            if self._is_ending:
                raise UserError(message) from error
            CONSOLE.log(f"[red]{escape(message)}. Training continues.[/red]")
            return
        if self.config.save_only_latest_checkpoint:
            for other in self.checkpoint_dir.glob("*.ckpt"):
                if other != path:
                    other.unlink()

    def _write_checkpoint(self, step: int, path: Path) -> None:
        torch.save(
            {
                "step": step,
                "pipeline": self.pipeline.state_dict(),
                "optimizers": {name: o.state_dict() for name, o in self.optimizers.optimizers.items()},
                "schedulers": {name: s.state_dict() for name, s in self.optimizers.schedulers.items()},
                "scalers": self.grad_scaler.state_dict(),
                "run": run_state(self.pipeline),
            },
            path,
        )


def add_rows_to_state(optimizer: Optimizer) -> None:
    """Give rows that a resumed run added to a parameter (vectors of new photos) an optimizer state of 0."""
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            if value.dim() and len(value) < len(parameter):
                added = value.new_zeros(len(parameter) - len(value), *value.shape[1:])
                state[name] = torch.cat((value, added))


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else Path(path).expanduser().absolute()
