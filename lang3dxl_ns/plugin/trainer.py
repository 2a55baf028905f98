"""Trainer with atomic checkpoints, exact resume, stopping, and guarded steps."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch.cuda.amp.grad_scaler import GradScaler

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.device import multiplies_bfloat16
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.common.memory import ran_out_of_memory
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.common.stages import Stages
from lang3dxl_ns.common.stopping import stoppable
from lang3dxl_ns.files.runs import say_what_to_do, scenes_in
from lang3dxl_ns.files.scene_file import SUFFIX, Provenance, replace_scene
from lang3dxl_ns.plugin.optimizers import GuardedOptimizers
from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline, Lang3DXLPipelineConfig
from lang3dxl_ns.plugin.run_checkpoint import check_checkpoint, read_checkpoint
from lang3dxl_ns.preparation.needs import NEEDS_FILE, write_needs
from lang3dxl_ns.preparation.store import PhotosGoneError
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord
from lang3dxl_ns.training.checkpoint import NOT_A_CHECKPOINT, alone_in, check_same_photos, save_checkpoint
from lang3dxl_ns.training.estimate import estimate
from lang3dxl_ns.training.learn_codes import forget_words
from lang3dxl_ns.training.learning_rates import add_rows_to_state
from lang3dxl_ns.training.memory import out_of_memory, plan
from lang3dxl_ns.training.snapshot import snapshot
from lang3dxl_ns.training.step_guard import StepGuard

_BEFORE_TRAINING = ("config.yml", SCENE_FILE, f"{NEEDS_FILE}.*", "dataparser_transforms.json", "events.*")
"""Names of a run's files that are written before training."""


class _Stopped(BaseException):
    """Raised when a signal arrives while words are learned, or a finished run is shown."""


@contextmanager
def _disk_kept_out_of_training() -> Iterator[None]:
    """Let training continue if its log (tensorboard's events) can't be written, as on a full disk.
    tensorboard's own thread prints such an error, keeps it, and raises it in the step that next logs."""
    write, ends_badly = writer.write_out_storage, threading.excepthook

    def told_once(thread: threading.ExceptHookArgs) -> None:
        if not isinstance(thread.exc_value, OSError):
            ends_badly(thread)

    def guarded() -> None:
        try:
            write()
        except OSError as error:
            writer.EVENT_WRITERS[:] = [w for w in writer.EVENT_WRITERS if isinstance(w, writer.LocalWriter)]
            CONSOLE.log(escape(f"The log can't be written ({error}). Training continues without it."))
            write()

    writer.write_out_storage, threading.excepthook = guarded, told_once
    try:
        yield
    finally:
        writer.write_out_storage, threading.excepthook = write, ends_badly


@dataclass
class RunConfig(TrainerConfig):
    """Settings that the trainer reads; `Lang3DXLTrainerConfig` fits them to a run."""

    pipeline: Lang3DXLPipelineConfig = field(default_factory=Lang3DXLPipelineConfig)
    max_skipped_steps: int = 20
    """Most steps in a row that are skipped, because loss or gradient is not finite, before the run stops."""


def requested_checkpoint(config: TrainerConfig) -> Path | None:
    """Find the checkpoint that a run's settings resume. Raises UserError if it doesn't exist."""
    folder, path = config.load_dir, config.load_checkpoint
    if folder is not None:
        folder = expanded(folder)
        step = "*" if config.load_step is None else f"{config.load_step:09d}"
        path = max(folder.glob(f"step-{step}.ckpt"), default=folder / f"step-{step}.ckpt")
    path = path and expanded(path)
    if path is not None and not path.is_file():
        raise UserError(f"there is no checkpoint {path}: pass the folder nerfstudio_models of a run")
    return path


class Lang3DXLTrainer(Trainer):
    """nerfstudio's trainer with atomic checkpoints, resumed runs that end at the requested iteration, and a
    guard against steps that are not finite."""

    config: RunConfig
    pipeline: Lang3DXLPipeline
    optimizers: GuardedOptimizers
    stages: Stages
    """Announced stages of the run: `prepare`, `train`, `words`. A longer command replaces this list."""
    interrupted: signal.Signals | None = None
    """The signal that stopped the run, if one did."""
    words_are_learned = False
    """Whether the final words of the run are learned. Words that a viewer learns during a run don't count."""
    _is_learning_words = False
    _is_shown = False  # finished and saved, with its viewer open
    _last_iteration = -1
    _is_ending = False
    _run_state: dict[str, Any] | None = None

    def __init__(self, config: RunConfig, local_rank: int = 0, world_size: int = 1) -> None:
        """Set up mixed precision: bfloat16 where the hardware has it. Its range is float32's, so gradients
        need no scale, and no step is lost or waits for one. Older GPUs (before Ampere) use float16 with a
        scale. Raises UserError for a CPU without bfloat16, on which nerfstudio would ignore the setting."""
        super().__init__(replace(config, mixed_precision=False), local_rank, world_size)
        self.config, self.mixed_precision = config, config.mixed_precision
        self.stages = Stages({"prepare": 0.3, "train": 0.6, "words": 0.1})
        if self.mixed_precision:
            on_cpu = self.device == "cpu"
            if on_cpu and not multiplies_bfloat16():
                raise UserError("--mixed-precision True gains nothing: this CPU does not multiply bfloat16")
            wide = on_cpu or torch.cuda.is_bf16_supported(including_emulation=False)
            torch.set_autocast_dtype(config.machine.device_type, torch.bfloat16 if wide else torch.float16)
            self.use_grad_scaler = config.use_grad_scaler or not wide
            self.grad_scaler = GradScaler(enabled=self.use_grad_scaler)
            if on_cpu:  # nerfstudio has just said the opposite
                CONSOLE.print("It is enabled after all: this CPU multiplies bfloat16.")

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Set up, then seed, so that preparation does not affect the run's randomness. A scene description is
        written into the run's folder, so that it can be queried without the photos."""
        # nerfstudio turns this on, and would then tune for photos of many sizes in nearly every step.
        torch.backends.cudnn.benchmark = False
        try:
            with self.stages.stage("prepare"):
                self._set_up(test_mode)
        except UserError:
            self._forget_folder()
            raise

    def _set_up(self, test_mode: Literal["test", "val", "inference"]) -> None:
        data, self.config.data = self.config.data, None  # otherwise the viewer would write camera paths there
        try:
            super().setup(test_mode)
        finally:
            self.config.data = data
        for optimizer in self.optimizers.optimizers.values():
            add_rows_to_state(optimizer)
        photos, run = self.pipeline.datamanager.data, self.pipeline.model.run
        photos.record().write(self.base_dir / SCENE_FILE)
        if test_mode == "val":
            write_needs(photos.needs, self.base_dir)
        CONSOLE.log(escape(plan(run, photos.cameras)))
        torch.manual_seed(self.config.machine.seed)
        if self._run_state is not None:
            photos.restore(self._run_state["photos"])
            run.restore(self._run_state)

    def _forget_folder(self) -> None:
        """Remove the folder of a run that could not start, if it holds nothing but what is written before
        training, and the folders above that this leaves empty."""
        with suppress(OSError):
            files = list(self.base_dir.iterdir())
            if all(any(path.match(name) for name in _BEFORE_TRAINING) for path in files):
                for path in files:
                    path.unlink()
                for folder in (self.base_dir, *self.base_dir.parents[:3]):
                    folder.rmdir()  # the first folder that is not empty raises, and ends the loop

    def _load_checkpoint(self) -> None:
        """Load the requested checkpoint, if any, as nerfstudio does, but keep the run state until everything
        is set up. Raises UserError if it doesn't exist, is damaged, or is another file."""
        if (path := requested_checkpoint(self.config)) is None:
            return
        check_checkpoint(path)
        state = read_checkpoint(path)
        if (before := path.parent.with_name(SCENE_FILE)).is_file():
            record, data = SceneRecord.read(before), self.pipeline.datamanager.data
            if not record.has_frame(data.capture.recorded_frame):
                raise UserError(
                    f"{path} belongs to other photos or another reconstruction of them: train anew"
                )
            splits = {photo.name: photo.split for photo in record.photos}
            check_same_photos(path, splits, data.splits, state["pipeline"])
        remedy = "give --load-dir a run's folder nerfstudio_models, or --load-checkpoint one of its files"
        with readable(f"{path} is not a checkpoint of lang3dxl", remedy, NOT_A_CHECKPOINT):
            self._start_step = state["step"] + 1
            self.pipeline.load_pipeline(state["pipeline"], state["step"])
            if left_out := sorted(set(state["optimizers"]) - set(self.optimizers.optimizers)):
                raise UserError(
                    f"{path} was trained with {', '.join(left_out)}, which the current settings leave out: "
                    "pass the options that the run began with, or train anew"
                )
            self.optimizers.load_optimizers(state["optimizers"])
            if self.config.load_scheduler:
                self.optimizers.load_schedulers(state["schedulers"])
            if state["scalers"]:  # a run without a loss scale has none
                self.grad_scaler.load_state_dict(state["scalers"])
            self._run_state, self.words_are_learned = state["run"], state["words"]
        CONSOLE.log(f"Loaded {path}")

    def eval_iteration(self, step: int) -> None:
        """Evaluate in between as nerfstudio does. Photos that can't be read don't end the training."""
        try:
            super().eval_iteration(step)
        except PhotosGoneError:
            raise
        except UserError as error:
            CONSOLE.log(escape(f"not evaluated at iteration {step}: {error}"))

    def setup_optimizers(self) -> Optimizers:
        """Build the optimizers, with the guard before them."""
        self.guard = StepGuard(self.config.max_skipped_steps, lambda message: CONSOLE.log(escape(message)))
        groups = self.pipeline.get_param_groups()
        return GuardedOptimizers(self.config.optimizers.copy(), groups, self._step_is_sound)

    def _step_is_sound(self, grad_scaler: GradScaler) -> bool:
        scale, photo = grad_scaler.get_scale(), self.pipeline.datamanager.data.photo_in_hand
        losses, parameters = self.pipeline.last_losses, self.optimizers.live_parameters()
        sound = self.guard.allows(self.step, photo, losses, parameters, scale)
        # Densification accumulates the gradients of screen positions, which are just as broken, and scaled
        # alike.
        self.pipeline.model.run.step_is_sound = sound
        self.pipeline.model.run.densification.loss_scale = scale
        return sound

    @property
    def _needs_words(self) -> bool:
        return self.pipeline.model.run.learns_words_at_the_end and not self.words_are_learned

    @property
    def is_finished(self) -> bool:
        """Whether the loaded checkpoint has all iterations, and the words if they are learned after them."""
        beyond = self._start_step - self.config.max_num_iterations
        return beyond > 0 or (beyond == 0 and not self._needs_words)

    @property
    def has_final_words(self) -> bool:
        """Whether the words of the run's end are learned: from then on the model stays as it is."""
        return self._is_ending and self.words_are_learned

    def train(self) -> None:
        """Train up to `max_num_iterations` in total (nerfstudio would add that many to a resumed run), then
        learn words. A run that was stopped between the two learns words only. Raises SystemExit after a
        signal stopped the run: 130 for Ctrl-C, 143 for SIGTERM."""
        total = self.config.max_num_iterations
        if self.is_finished:
            self._forget_folder()
            raise UserError(
                f"the checkpoint in {self.config.load_dir or self.config.load_checkpoint} already has "
                f"{self._start_step} iterations, and the run has {total}: "
                f"pass --max-num-iterations with a larger number"
            )
        if self._start_step:
            CONSOLE.log(f"Resuming at iteration {min(self._start_step, total)} of {total}")
        self.config.max_num_iterations = max(total - self._start_step, 0)
        self._last_iteration = self._start_step - 1
        self.step = max(self._last_iteration, 0)
        if self._start_step < total:
            self.words_are_learned = False  # the checkpoint's words will be out of date
            forget_words(self.pipeline.model.run)
        try:
            self._announce_time()
            writer.GLOBAL_BUFFER.setdefault("step", self.step)  # the end reads it, also without any step
            self.stages.begin("train")
            with alone_in(self.base_dir), stoppable(self._stop), _disk_kept_out_of_training():
                super().train()
        except PhotosGoneError as error:
            raise UserError(f"{error}. {self._stop_early()}") from error
        except (RuntimeError, MemoryError) as error:
            if not ran_out_of_memory(error):
                raise
            raise UserError(self._out_of_memory()) from error
        finally:
            self.stages.end()
            self.config.max_num_iterations = total
            if summary := self.guard.summary():
                CONSOLE.log(escape(summary))
        if self.interrupted is not None:
            sys.exit(128 + self.interrupted)

    def _announce_time(self) -> None:
        """Log how long training and learning words will take with the present Gaussians."""
        count, cameras = self.config.max_num_iterations, self.pipeline.datamanager.data.cameras
        with self.train_lock:  # the viewer may render at the same time
            line, words = estimate(self.pipeline.model.run, cameras, count)
        self.stages.weigh("words", "train", words)
        CONSOLE.log(line)

    def train_iteration(self, step: int):
        loss, losses, metrics = super().train_iteration(step)
        self._last_iteration = step
        done = (step + 1 - self._start_step) / self.config.max_num_iterations
        self.stages.progress(done, f"{self.pipeline.model.num_points:,} Gaussians")
        # nerfstudio keeps these through the next step, and what they were computed from with them.
        return loss.detach(), {name: value.detach() for name, value in losses.items()}, metrics

    def _stop(self, number: signal.Signals) -> None:
        """End training after the current iteration, with a checkpoint. Learning words, which a checkpoint
        precedes, ends at once, and so does the viewer of a finished run."""
        if not self._is_shown:
            self.interrupted, self.stop_training = number, True
        if self._is_learning_words or self._is_shown:
            raise _Stopped

    def _stop_early(self) -> str:
        """Save a checkpoint when training can't continue, and return a message about it."""
        self._is_ending = True
        if self._last_iteration < self._start_step:
            return "Nothing was learned yet"
        self.save_checkpoint(self._last_iteration)
        return self._how_to_resume(self._last_iteration)

    def _how_to_resume(self, step: int) -> str:
        folder = shlex.quote(str(self.checkpoint_dir))
        return f"Stopped after {step + 1} iterations. To resume: the same command with --load-dir {folder}"

    def _out_of_memory(self) -> str:
        """Describe what happened and what helps. The latest checkpoint is not replaced, since the interrupted
        step may have left incomplete tensors."""
        when = "while learning words" if self._is_ending else f"at iteration {self.step}"
        saved, kept = max(self.checkpoint_dir.glob("step-*.ckpt"), default=None), "none is saved yet"
        if saved is not None:
            kept = f"{saved} is kept: --load-dir {self.checkpoint_dir} resumes there"
        smaller = data_option("camera-res-scale-factor 0.5")
        return out_of_memory(self.pipeline.model.num_points, when, smaller, kept)

    def _after_train(self) -> None:
        """Save, learn words, save again. If interrupted, print how to resume, and leave the viewer."""
        self._is_ending = True
        self.stages.end()
        if self.interrupted:
            self.step = max(self._last_iteration, 0)  # not the iteration that was about to begin
        elif self.pipeline.model.run.learns_words_at_the_end:
            self.save_checkpoint(self.step)
            self._learn_words()
        if self.interrupted:
            self.config.viewer.quit_on_train_completion = True
            CONSOLE.print(self._how_to_resume(self.step), soft_wrap=True)
        # As nerfstudio's own, but its tables come before the lines that say what to do next.
        self.training_state = "completed"
        writer.write_out_storage()
        self.save_checkpoint(self.step)
        for callback in self.callbacks:
            callback.run_callback_at_location(self.step, TrainingCallbackLocation.AFTER_TRAIN)
        if not (self.config.viewer.quit_on_train_completion or self.interrupted):
            with suppress(_Stopped):
                self._is_shown = True
                self._train_complete_viewer()

    def write_scene(self) -> None:
        """Write the trained scene as one file into the run's folder, for queries and sharing. It keeps the
        words taught in an earlier file there, or in the folder of the run that this one resumed."""
        data, model = self.pipeline.datamanager.data, self.pipeline.model
        path = self.base_dir / f"{data.capture.folder.name or 'scene'}{SUFFIX}"
        config, place = model.config, self.config.load_checkpoint
        how = f"{self.config.method_name}, {config.decoder.name}, {config.total_steps} iterations"
        file = data.record(model.run)
        file.write(self.base_dir / SCENE_FILE)
        scene = snapshot(model.run, file)
        checkpoints = self.config.load_dir or (place and place.parent)
        earlier = scenes_in(checkpoints.parent) if checkpoints else []  # may be renamed
        told = Provenance(title=path.stem, made_how=how)
        _, size = replace_scene(path, scene, told, *earlier)
        say(f"The scene:       {os.path.relpath(path)} ({size / 1e6:.1f} MB)")
        say_what_to_do(os.path.relpath(self.base_dir), model.semantic_field is not None)

    def _learn_words(self) -> None:
        # Hold the lock, since the viewer may be learning words for a recent question.
        with suppress(_Stopped), self.stages.stage("words"), self.train_lock:
            try:
                self._is_learning_words = True
                if not self.interrupted:
                    self.pipeline.learn_words()
                    self.words_are_learned = True
            finally:
                self._is_learning_words = False

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Write the checkpoint beside its folder and move it in, so that a killed run leaves no partial one.
        If it can't be written, training continues; at the end of training, UserError is raised."""
        path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        state = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: o.state_dict() for name, o in self.optimizers.optimizers.items()},
            "schedulers": {name: s.state_dict() for name, s in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
            "run": self.pipeline.model.run.progress() | {"photos": self.pipeline.datamanager.data.state()},
            "words": self.words_are_learned,
        }
        try:
            save_checkpoint(path, state, self.base_dir / f"{path.name}.partial")
        except UserError as error:
            if self._is_ending:
                raise
            CONSOLE.log(f"[red]{escape(str(error))}. Training continues.[/red]")
            return
        if self.config.save_only_latest_checkpoint:
            for other in set(self.checkpoint_dir.glob("*.ckpt")) - {path}:
                other.unlink()
        done = step + 1 >= self.config.pipeline.model.total_steps
        if self._is_ending and done and not self._needs_words:
            self.write_scene()
