"""Training from start to end: prepare targets, train, learn words, save; a stopped run goes on."""

from __future__ import annotations

import functools
import threading
import warnings
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_type_hints

import torch
from torch.optim.lr_scheduler import LambdaLR
from typeguard import TypeCheckError, check_type

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.device import best_device
from lang3dxl_ns.common.errors import UserError, in_a_line
from lang3dxl_ns.common.files import expanded, replace_file
from lang3dxl_ns.common.memory import ran_out_of_memory
from lang3dxl_ns.common.stages import Stages
from lang3dxl_ns.common.stopping import stoppable
from lang3dxl_ns.files.scene_file import SUFFIX, Provenance, describe_scene_file, replace_scene
from lang3dxl_ns.preparation.model_files import check_encoders
from lang3dxl_ns.preparation.needs import needs_table, write_needs
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import PhotosGoneError
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.scene.capture import Capture, open_capture, say_held_out, say_left_out
from lang3dxl_ns.scene.capture_settings import CAPTURE_BOUNDS, CaptureSettings
from lang3dxl_ns.scene.companions import cache_folder
from lang3dxl_ns.scene.photo_folder import check_data
from lang3dxl_ns.scene.record import SCENE_FILE
from lang3dxl_ns.training.batches import TrainingData, settled
from lang3dxl_ns.training.checkpoint import (
    CHECKPOINT,
    alone_in,
    as_damage,
    check_same_photos,
    read_checkpoint,
    save_checkpoint,
)
from lang3dxl_ns.training.estimate import check_device, estimate
from lang3dxl_ns.training.learn_codes import begin_codes, forget_words, learn_words
from lang3dxl_ns.training.learning_rates import (
    Rates,
    add_rows_to_state,
    learning_rates,
    printed_learning_rates,
)
from lang3dxl_ns.training.memory import out_of_memory, plan
from lang3dxl_ns.training.scene_settings import PRINTED_PHOTO_SCALE, Method, RunSettings
from lang3dxl_ns.training.settings import TrainingSettings, as_printed, without_effect
from lang3dxl_ns.training.snapshot import snapshot
from lang3dxl_ns.training.state import Training
from lang3dxl_ns.training.step import finish, losses, render
from lang3dxl_ns.training.step_guard import StepGuard

USUAL_STEPS = {"lang3dxl": 30_000, "lang3dxl-paper": 70_000}
"""Iterations on a GPU, by method."""
STEPS_ON_A_CPU = 3_000
"""A step on a CPU takes 0.1 s or more, so the default is a run that ends within minutes."""


_BOUNDS = {"steps": (1, 1e9), "save_every": (1, 1e9), "photo_scale": (0.001, 8), "seed": (0, 2**32 - 1)}
_OF_THE_MACHINE = {
    *("cache_dir", "workers", "engine", "address", "crop_batch", "rasterizer", "max_gaussians"),
    *("mixed_precision", "save_every", "max_skipped_steps", "total_steps", "skip_damaged_masks"),
    *("colmap_path", "images_path", "masks_path", "follow_links"),
}
"""Settings that may change when a run goes on: where it runs, what is where, and how often it is saved."""


@dataclass
class Settings(RunSettings):
    """Settings of a run."""

    method: Method = "lang3dxl"
    steps: int = STEPS_ON_A_CPU
    """Iterations in all."""
    scene: TrainingSettings = field(default_factory=TrainingSettings)
    targets: PreparationConfig = field(default_factory=PreparationConfig)
    rates: Rates = field(default_factory=learning_rates)
    capture: CaptureSettings = field(default_factory=CaptureSettings)
    photo_scale: float = 1.0
    """Size of the training photos relative to the files'."""
    max_skipped_steps: int = 20
    """Most steps in a row without a finite loss or gradient before the run stops."""

    @staticmethod
    def of(method: Method, steps: int | None = None) -> Settings:
        """Return the usual settings of a method, for its usual number of iterations on this machine unless
        another is given."""
        if method not in USUAL_STEPS:
            raise UserError(f"there is no method {method!r}: choose one of {', '.join(USUAL_STEPS)}")
        usual = USUAL_STEPS[method] if best_device() == "cuda" else STEPS_ON_A_CPU
        settings = Settings(method, usual if steps is None else steps)
        if method == "lang3dxl-paper":
            as_printed(settings.scene, settings.targets)
            settings.rates, settings.photo_scale = printed_learning_rates(), PRINTED_PHOTO_SCALE
        return settings

    def set(self, name: str, value: Any) -> None:
        """Set a setting of the run, or of its scene, targets or capture, by name (`looks` too). Raises
        UserError for a name that there is not, and for a value of another kind."""
        owners: tuple[Any, ...] = self.scene, self.targets, self.capture, self
        owner = next((part for part in owners if name in get_type_hints(type(part))), None)
        attribute = name
        if name == "looks":
            owner, attribute = self.scene.appearance, "use"
        if owner is None:
            known = [setting.name for part in owners for setting in fields(part)]
            near = "".join(f"did you mean {n}? " for n in get_close_matches(name, known, n=1))
            raise UserError(f"there is no setting {name}: {near}help(lang3dxl_ns.train) names them")
        kind = get_type_hints(type(owner))[attribute]
        if isinstance(value, str) and kind in (Path, Path | None):
            value = Path(value)
        try:
            check_type(value, kind)
        except TypeCheckError as error:
            raise UserError(f"{name} can't be {value!r}: it {in_a_line(error)}") from error
        setattr(owner, attribute, value)

    def check_effect(self) -> None:
        """Raise UserError for a setting that has no effect with this method. Call this before `resolved`,
        which fills settings in."""
        of_scene, of_targets = without_effect(self.scene, self.targets)
        if changed := [*of_scene, *of_targets]:
            raise UserError(
                f"--{changed[0].replace('_', '-')} has no effect where words are learned after "
                "training: leave it off, or train with --method lang3dxl-paper"
            )

    def resolved(self) -> Settings:
        """Check all settings, and return them with the values that depend on the length of the run. Raises
        UserError for a setting that is out of its range."""
        check_numbers(self, _BOUNDS)
        check_numbers(self.capture, CAPTURE_BOUNDS)
        self.scene.check()
        self.targets.check()
        scene, learned = self.scene.fitted(self.steps), self.scene.decoder.learns_from_renderings
        targets = settled(self.targets, learned, not learned or scene.codes_from == "photos")
        rates = {
            name: (rate.fitted(self.steps), schedule and replace(schedule, total_steps=self.steps))
            for name, (rate, schedule) in self.rates.items()
        }
        return replace(self, scene=scene, targets=targets, rates=rates)


class Run:
    """A run in progress: what is trained, its photos and its optimizers."""

    def __init__(self, capture: Capture, settings: Settings, folder: Path, cache_dir: Path, device: str):
        self.settings, self.folder, self.device = settings, folder, device
        self.about = _about(settings, capture)
        learned, scale = settings.scene.decoder.learns_from_renderings, settings.photo_scale
        self.data = TrainingData(capture, settings.targets, cache_dir, device, learned, scale)
        self.path = folder / f"{capture.folder.name or 'scene'}{SUFFIX}"
        self.done, self.words_are_learned, self.title = 0, False, self.path.stem
        self.again = "the same command"
        facts = self.data.facts()
        say(needs_table(self.data.needs))
        torch.manual_seed(settings.seed)
        self.state = Training.begin(settings.scene, facts, capture.seeds)
        self.state.to(device)
        optimized = self.state.groups()
        self.optimizers = {name: settings.rates[name][0].adam(group) for name, group in optimized.items()}
        self.schedulers: dict[str, LambdaLR] = {}
        for name, optimizer in self.optimizers.items():
            if (schedule := settings.rates[name][1]) is not None:
                self.schedulers[name] = schedule.scheduler(optimizer)
        self.state.optimizers = self.optimizers
        self.guard = StepGuard(settings.max_skipped_steps, say)
        say(plan(self.state, self.data.cameras))
        torch.manual_seed(settings.seed)

    def iterate(self, step: int) -> None:
        """Train one iteration."""
        state, data = self.state, self.data
        state.step = step
        begin_codes(state, data)
        for optimizer in self.optimizers.values():
            optimizer.zero_grad()
        view, batch = data.next()
        with torch.autocast("cuda", torch.bfloat16, self.settings.mixed_precision):
            rendered = render(state, view)
            found = losses(state, rendered.rgb, rendered.codes, batch)
        functools.reduce(torch.add, found.values()).backward()
        groups = {n: [p for g in o.param_groups for p in g["params"]] for n, o in self.optimizers.items()}
        state.step_is_sound = self.guard.allows(step, data.photo_in_hand, found, groups)
        for name, optimizer in self.optimizers.items():
            if not state.step_is_sound:
                optimizer.zero_grad()
            elif any(parameter.grad is not None for parameter in groups[name]):
                optimizer.step()
        for scheduler in self.schedulers.values():
            scheduler.step()
        finish(state)

    def scene(self) -> Scene:
        """Return the scene so far, which later training doesn't change."""
        return snapshot(self.state, self.data.record(self.state))

    def save(self, step: int) -> Scene:
        """Write the checkpoint after an iteration, and the scene so far."""
        state = {
            "about": self.about,
            "step": step,
            "tensors": self.state.tensors(),
            "optimizers": {name: o.state_dict() for name, o in self.optimizers.items()},
            "schedulers": {name: s.state_dict() for name, s in self.schedulers.items()},
            "splits": self.data.splits,
            "run": self.state.progress() | {"photos": self.data.state()},
            "words": self.words_are_learned,
        }
        save_checkpoint(self.folder / CHECKPOINT, state)
        told = f"{self.settings.method}, {step + 1} of {self.settings.steps} iterations"
        return replace_scene(self.path, self.scene(), Provenance(title=self.title, made_how=told))[0]

    def resume(self) -> None:
        """Go on where the folder's checkpoint ends, if there is one."""
        path = self.folder / CHECKPOINT
        if (saved := read_checkpoint(path, self.about)) is None:
            return
        with as_damage(path):
            splits = self.data.splits  # which earlier versions didn't save
            check_same_photos(path, saved.get("splits", splits), splits, saved["tensors"])
            self.done, self.words_are_learned = saved["step"] + 1, saved["words"]
            self.state.load(saved["tensors"])
            for name, content in saved["optimizers"].items():
                self.optimizers[name].load_state_dict(content)
                add_rows_to_state(self.optimizers[name])
            for name, content in saved["schedulers"].items():
                self.schedulers[name].load_state_dict(content)
            self.data.restore(saved["run"]["photos"])
            self.state.restore(saved["run"])
        self.state.step = saved["step"]
        if self.done < self.settings.steps:
            forget_words(self.state)
        say(f"Resuming at iteration {self.done} of {self.settings.steps}")

    @property
    def is_finished(self) -> bool:
        """Whether all iterations are done, and the words are learned."""
        words = self.words_are_learned or not self.state.learns_words_at_the_end
        return self.done >= self.settings.steps and words

    def complete(self, stages: Stages) -> Scene:
        """Do what is left: iterations, then words. Raises as `fit`."""
        if self.is_finished and self.path.exists():
            with suppress(UserError):  # a damaged file is set aside below, and written anew
                words = describe_scene_file(self.path)["taught"]
                say("The run is finished already")
                return self.scene().with_words(words)
        first, steps = self.done, self.settings.steps
        try:
            self._train(stages)
            if self.state.learns_words_at_the_end and not self.words_are_learned:
                self._end_with_words(stages)
        except PhotosGoneError as error:
            if first < self.done < steps:
                self.save(self.done - 1)
            raise UserError(f"{error}. To resume: {self.again}") from error
        except (RuntimeError, MemoryError) as error:
            if not ran_out_of_memory(error):
                raise
            kept = self.folder / CHECKPOINT
            told = f"{kept} is kept: {self.again} resumes there" if kept.exists() else "none is saved yet"
            when = f"at iteration {self.done}" if self.done < steps else "while learning words"
            raise UserError(out_of_memory(len(self.state.means), when, "--photo-scale 0.5", told)) from error
        if summary := self.guard.summary():
            say(summary)
        return self.save(steps - 1)

    def _train(self, stages: Stages) -> None:
        """Do the iterations that are left, with a checkpoint now and then and after the last one."""
        first, steps, asked = self.done, self.settings.steps, threading.Event()
        every = min(self.settings.save_every, max(steps // 4, 1))
        if first < steps:
            line, words = estimate(self.state, self.data.cameras, steps - first)
            stages.weigh("words", "train", words)
            say(line)
        with stages.stage("train"), stoppable(lambda _: asked.set()):
            for step in range(first, steps):
                self.iterate(step)
                self.done = step + 1
                stages.progress((self.done - first) / (steps - first), f"{len(self.state.means):,} Gaussians")
                ends = self.done == steps  # with a checkpoint only if words follow
                due = self.state.learns_words_at_the_end if ends else self.done % every == 0
                if asked.is_set() or due:
                    try:
                        self.save(step)
                    except (OSError, UserError) as error:
                        if asked.is_set() or ends:
                            raise
                        say(f"{error}. Training continues.")
                if asked.is_set():
                    say(f"Stopped after {self.done} iterations. To resume: {self.again}")
                    raise KeyboardInterrupt

    def _end_with_words(self, stages: Stages) -> None:
        """Learn words, which a checkpoint precedes."""
        try:
            with stages.stage("words"):
                learn_words(self.state, self.data)
        except KeyboardInterrupt:
            say(f"Stopped while words were learned; all iterations are kept. To resume: {self.again}")
            raise
        self.words_are_learned = True


def _about(settings: Settings, capture: Capture) -> dict[str, Any]:
    """Describe what a checkpoint must agree in to be resumed: the photos, and the plain settings."""
    frame = capture.recorded_frame
    photos = [round(v, 3) for v in (*frame.transform.flatten().tolist(), frame.scale)]
    parts = settings.capture, settings.targets, settings.scene, settings
    plain = {f.name: getattr(part, f.name) for part in parts for f in fields(part)}
    plain["looks"] = settings.scene.appearance.use
    told = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in plain.items()
        if name not in {*_OF_THE_MACHINE, "rates"} and not is_dataclass(value)
    }
    return told | {"photos": photos}


def begin(
    capture: Capture,
    settings: Settings,
    out: Path,
    cache_dir: Path,
    device: str | None = None,
    restart: bool = False,
) -> Run:
    """Prepare a run, or the continuation of the folder's; see `fit`."""
    # A group without gradients so far has a schedule all the same.
    warnings.filterwarnings("ignore", "Detected call of .lr_scheduler.step")
    device = device or best_device()
    settings = _resolved(settings, device)
    replace_file(trial := out / "training.trial", b"")  # the folder may be another user's
    trial.unlink()
    torch.manual_seed(settings.seed)
    run = Run(capture, settings, out, cache_dir, device)
    if restart:  # now that nothing is in its way
        (out / CHECKPOINT).unlink(missing_ok=True)
        run.again = "the same command without --restart"
    run.resume()
    run.data.record(run.state).write(out / SCENE_FILE)
    write_needs(run.data.needs, out)
    return run


def _resolved(settings: Settings, device: str) -> Settings:
    """Return `Settings.resolved`. Raises UserError also for what the device can't do."""
    settings = settings.resolved()
    check_device(device, settings.scene.rasterizer)
    if settings.mixed_precision and not (device.startswith("cuda") and torch.cuda.is_bf16_supported(False)):
        raise UserError("--mixed-precision needs a GPU that multiplies bfloat16 (since Ampere): leave it off")
    return settings


def fit(
    capture: Capture,
    settings: Settings,
    out: Path,
    cache_dir: Path,
    device: str | None = None,
    restart: bool = False,
) -> Scene:
    """Train a scene, or go on with the run in a folder.

    Args:
        capture: photos with cameras and points.
        settings: settings of the run.
        out: folder of the run; it gets NAME.scene, also at every checkpoint, the checkpoint, and records of
            the photos and of what they need.
        cache_dir: folder of prepared targets.
        device: by default a GPU if there is one.
        restart: whether to forget the folder's run.

    Raises:
        UserError: the photos or settings cannot be used, another command trains in the folder, or its run is
            another one.
        KeyboardInterrupt: Ctrl-C or SIGTERM stopped the run, after a checkpoint.
    """
    stages = Stages({"prepare": 0.3, "train": 0.6, "words": 0.1})
    with alone_in(out):
        with stages.stage("prepare"):
            run = begin(capture, settings, out, cache_dir, device, restart)
        return run.complete(stages)


def run_folder(
    data: str | Path, out: str | Path | None, settings: Settings, restart: bool = False
) -> tuple[Path, Scene]:
    """Open the capture in a folder, and train it as `fit`; return the folder of the run, by default
    outputs/NAME, and the scene. `restart` forgets the folder's run. Raises as `fit`."""
    check_data(expanded(data))
    settings = _resolved(settings, best_device())
    check_encoders(settings.targets.clip, settings.targets.dense)
    capture = open_capture(data, settings.capture, settings.targets.cache_dir)
    say_left_out(capture)
    say_held_out(capture)
    folder = Path("outputs") / (capture.folder.name or "scene") if out is None else expanded(out)
    cache = cache_folder(capture.folder, settings.targets.cache_dir)
    return folder, fit(capture, settings, folder, cache, restart=restart)


def train(
    data: str | Path,
    out: str | Path | None = None,
    *,
    steps: int | None = None,
    method: Method = "lang3dxl",
    restart: bool = False,
    **settings: Any,
) -> Scene:
    """Train a scene from photos, or go on with a run that was stopped, and return it.

    Args:
        data: folder of photos, with or without a COLMAP model or transforms.json, or a video.
        out: folder of the run, in which NAME.scene is written; by default outputs/NAME.
        steps: iterations; by default 30,000 (70,000 for `lang3dxl-paper`) on a GPU and 3,000 without one.
        method: `lang3dxl`, or `lang3dxl-paper` as printed.
        restart: train anew, over the run in the folder.
        **settings: settings of `TrainingSettings`, `PreparationConfig`, `CaptureSettings` and `Settings` by
            name, such as clip="builtin".

    Raises:
        UserError: the photos or settings cannot be used, or training was interrupted.
    """
    chosen = Settings.of(method, steps)
    for name, value in settings.items():
        chosen.set(name, value)
    chosen.check_effect()
    try:
        return run_folder(data, out, chosen, restart)[1]
    except KeyboardInterrupt as error:
        begun = ", without restart if iterations had begun" if restart else ""
        raise UserError(f"training was stopped; to resume: the same call{begun}") from error
