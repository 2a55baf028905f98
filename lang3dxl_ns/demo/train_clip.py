"""Trains the small CLIP that ships with the package, on crops of rendered landmarks with captions.

    python -m lang3dxl_ns.demo.train_clip --out DIR --cache DIR

About an hour on two CPU cores: one renders landmarks, one trains. A stopped run goes on with --resume. Equal
steps, seed and a complete cache of views give equal weights; a time limit that binds does not.
"""

from __future__ import annotations

import signal
import sys
import time
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float, Int
from numpy import ndarray as Array
from torch import Tensor, nn

from lang3dxl_ns.demo.captions import CLASSES, FITS, GENERIC, Caption, draw_caption
from lang3dxl_ns.demo.crops import Crops, augment, draw_crops, main_materials, patch_labels, soft_labels
from lang3dxl_ns.demo.small_clip import (
    GRID,
    IMAGE_SIZE,
    as_encoder,
    build_clip,
    build_tokenizer,
    normalise,
    save_clip,
    start_from_principal_components,
)
from lang3dxl_ns.demo.teacher import score_teacher
from lang3dxl_ns.demo.views import SPLITS, ViewFolder, background_rendering
from lang3dxl_ns.errors import UserError

_GENERIC_SHARE = 0.1  # how well a canonical phrase fits any crop, and the share of such captions
_MISMATCH = 0.3  # how much a caption still fits whose class is right but not its adjective or its family
_CAPTIONS = 48  # texts per step: fewer than crops, since they repeat
_REPORT_EVERY, _SAVE_SECONDS = 50, 120


@dataclass(kw_only=True)
class ClipTraining:
    """Train the small CLIP."""

    out: Path
    """Folder for the model, in Hugging Face format."""
    cache: Path
    """Folder for rendered views (1 MB each) and the checkpoint."""
    steps: int = 6_000
    """Training steps."""
    minutes: float = 55.0
    """Time limit: where steps are slow, the schedule is shortened to end in time."""
    batch: int = 128
    """Crops per step."""
    landmarks: int = 1_500
    """Training landmarks."""
    views: int = 2
    """Views of each landmark."""
    first_landmarks: int = 150
    """Landmarks that must be rendered before training starts."""
    render_processes: int = 1
    """Processes that render what the cache lacks while training goes on."""
    threads: int = 1
    """CPU threads of the training."""
    validation_landmarks: int = 12
    """Landmarks of the score that is printed now and then; 0 for none."""
    validate_every: int = 1_000
    """Steps between two such scores."""
    seed: int = 0
    """Of weights, crops and captions."""
    resume: bool = False
    """Go on from the checkpoint in the cache."""
    stop_after: int | None = None
    """Leave at this step with a checkpoint and no model, as if interrupted."""

    def main(self) -> None:
        torch.set_num_threads(self.threads)
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the rendering processes end too
        train(self)


class Trainee(nn.Module):
    """The CLIP in training, with a head that names each patch's classes and is thrown away afterwards."""

    def __init__(self, clip: Any) -> None:
        super().__init__()
        self.clip = clip
        self.patch_head = nn.Linear(clip.config.vision_config.hidden_size, len(CLASSES))

    def forward(self, pixels: Tensor, tokens: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Unit embeddings of crops and texts, and the class logits of the patches."""
        vision = self.clip.vision_model(pixel_values=pixels)
        images = self.clip.visual_projection(vision.pooler_output)
        texts = self.clip.get_text_features(**tokens).pooler_output
        return (
            F.normalize(images, dim=-1),
            F.normalize(texts, dim=-1),
            self.patch_head(vision.last_hidden_state[:, 1:]),
        )


class Run:
    """A training run: what is learned, how far it is, and its checkpoint."""

    def __init__(self, config: ClipTraining) -> None:
        self.config = config
        self.tokenizer = build_tokenizer(config.seed)
        torch.manual_seed(config.seed)
        self.trainee = Trainee(build_clip(self.tokenizer, config.seed))
        self.optimizer = torch.optim.AdamW(
            self.trainee.parameters(), lr=1e-3, betas=(0.9, 0.98), weight_decay=0.05, fused=True
        )
        self.step = 0
        self._earlier, self._started = 0.0, time.monotonic()
        self._checkpoint = config.cache / "checkpoint.pt"

    @property
    def seconds(self) -> float:
        """Time spent training, earlier runs included."""
        return self._earlier + time.monotonic() - self._started

    @property
    def progress(self) -> float:
        """0 at the start, 1 at the end: of the steps or of the time, whichever ends first."""
        return max(self.step / self.config.steps, self.seconds / max(60 * self.config.minutes, 1e-9))

    def save(self) -> None:
        state = {
            "model": self.trainee.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
        }
        temporary = self._checkpoint.with_suffix(".partial")
        torch.save(state, temporary)
        temporary.replace(self._checkpoint)

    def restore(self) -> None:
        """Go on from the checkpoint, or from the start without one."""
        if not self._checkpoint.exists():
            return
        state = torch.load(self._checkpoint, weights_only=True)
        try:
            self.trainee.load_state_dict(state["model"])
        except RuntimeError as error:
            raise UserError(
                f"{self._checkpoint} is of another model: delete it, or train without --resume"
            ) from error
        self.optimizer.load_state_dict(state["optimizer"])
        self.step, self._earlier = state["step"], state["seconds"]

    def start_clock(self) -> None:
        self._started = time.monotonic()


def train(config: ClipTraining) -> None:
    """Train as `config` says and write the model to `config.out`.

    Raises UserError when the checkpoint to resume from is of another model.
    """
    config.cache.mkdir(parents=True, exist_ok=True)
    run = Run(config)
    if config.resume:
        run.restore()
    validation = _validation_views(config)
    seeds = SPLITS["train"][: config.landmarks]
    with background_rendering(config.cache / "train", seeds, config.views, config.render_processes) as tasks:
        _fit(run, _first_views(config, tasks), validation)
    run.save()
    if run.step == config.stop_after:
        return
    save_clip(run.trainee.clip, run.tokenizer, config.out)
    print(
        f"{run.step} steps, {run.step * config.batch} crops, {run.seconds / 60:.0f} min: {config.out}",
        flush=True,
    )


def _fit(run: Run, folder: ViewFolder, validation: list[Array]) -> None:
    """Training steps until the run ends or is to stop."""
    config = run.config
    run.start_clock()
    if run.step == 0:
        crops = draw_crops(
            folder.landmarks, 4 * config.batch, 4, IMAGE_SIZE, np.random.default_rng(config.seed)
        )
        start_from_principal_components(run.trainee.clip, normalise(crops.images.float() / 255))
    saved, mean_loss = time.monotonic(), None
    while run.progress < 1 and run.step != config.stop_after:
        loss = _train_step(run, folder)
        mean_loss = loss if mean_loss is None else mean_loss + 0.05 * (loss - mean_loss)
        run.step += 1
        if run.step % _REPORT_EVERY == 0:
            folder.refresh()
            left = run.seconds * (1 / run.progress - 1) / 60
            rate = run.step * config.batch / run.seconds
            print(
                f"step {run.step}: loss {mean_loss:.3f}, {rate:.0f} crops/s, "
                f"{len(folder.landmarks)} landmarks, {100 * run.progress:.1f} %, {left:.0f} min left",
                flush=True,
            )
        if validation and run.step % config.validate_every == 0:
            print(
                f"step {run.step}: {score_teacher(as_encoder(run.trainee.clip, run.tokenizer), validation)}",
                flush=True,
            )
        if time.monotonic() - saved > _SAVE_SECONDS:
            run.save()
            saved = time.monotonic()


def learning_rate(step: int, progress: float) -> float:
    """Warm-up over 60 steps, then a cosine down to 2 % at progress 1."""
    cosine = 0.51 + 0.49 * np.cos(np.pi * min(progress, 1.0))
    return float(1.5e-3 * min(1.0, (step + 1) / 60) * cosine)


def caption_fit(
    captions: list[Caption],
    shares: Float[Array, "n k"],
    materials: Int[Array, "n k"],
    families: Int[Array, " n"],
) -> Float[Array, "n t"]:
    """How well each caption fits each crop: its class's share, less where adjective or family are wrong."""
    classes = [caption.class_ for caption in captions]
    everything = np.concatenate([shares, np.full((len(shares), 1), _GENERIC_SHARE)], axis=1)
    fit = everything[:, classes]
    for column, caption in zip(fit.T, captions, strict=True):
        if caption.adjective >= 0:
            column *= np.where(FITS[caption.adjective][materials[:, caption.class_]], 1.0, _MISMATCH)
        if caption.family >= 0:
            column *= np.where(families == caption.family, 1.0, _MISMATCH)
    return fit


def contrastive_loss(
    images: Float[Tensor, "n d"],
    texts: Float[Tensor, "t d"],
    fit: Float[Tensor, "n t"],
    classes: Int[Tensor, " t"],
    scale: Float[Tensor, ""],
) -> Float[Tensor, ""]:
    """Soft cross entropy of image→text and text→image, for unit embeddings of crops and captions.

    The targets are proportional to `fit`; image→text divides a class's share among its captions.
    """
    logits = scale * images @ texts.T
    shared = fit / (classes[:, None] == classes).sum(0)
    per_image = shared / shared.sum(1, keepdim=True).clamp(min=1e-6)
    per_text = fit / fit.sum(0, keepdim=True).clamp(min=1e-6)
    image_loss = -(per_image * logits.log_softmax(1)).sum(1).mean()
    text_loss = -(per_text * logits.log_softmax(0)).sum(0).mean()
    return (image_loss + text_loss) / 2


def _train_step(run: Run, folder: ViewFolder) -> float:
    rng = np.random.default_rng((run.config.seed, run.step))  # of the step: a resumed run draws the same
    crops = draw_crops(folder.landmarks, run.config.batch, 4, IMAGE_SIZE, rng)
    shares, materials = soft_labels(crops), main_materials(crops)
    captions = _draw_captions(crops, shares, materials, rng)
    fit = torch.from_numpy(caption_fit(captions, shares, materials, crops.families)).float()
    classes = torch.tensor([caption.class_ for caption in captions])
    tokens = run.tokenizer([caption.text for caption in captions], padding=True, return_tensors="pt")
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    pixels = normalise(augment(crops.images, torch.from_numpy(crops.inside), generator))

    images, texts, patches = run.trainee(pixels, dict(tokens))
    loss = contrastive_loss(images, texts, fit, classes, run.trainee.clip.logit_scale.exp())
    loss = loss + patch_loss(patches, torch.from_numpy(patch_labels(crops, GRID)).float())
    run.optimizer.param_groups[0]["lr"] = learning_rate(run.step, run.progress)
    run.optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(run.trainee.parameters(), 1.0)
    run.optimizer.step()
    with torch.no_grad():
        run.trainee.clip.logit_scale.clamp_(max=float(np.log(30.0)))
    return loss.item()


def patch_loss(logits: Float[Tensor, "n p k"], shares: Float[Tensor, "n p k"]) -> Float[Tensor, ""]:
    """Soft cross entropy of the patches inside the view; it teaches the patch tokens what stands where."""
    return -(shares * logits.log_softmax(-1)).sum() / shares.sum().clamp(min=1.0)


def _draw_captions(
    crops: Crops, shares: Float[Array, "n k"], materials: Int[Array, "n k"], rng: np.random.Generator
) -> list[Caption]:
    """Captions of some of the crops, each of a class drawn from the crop's shares, or generic."""
    captions = []
    for i in rng.choice(len(shares), min(_CAPTIONS, len(shares)), replace=False):
        if rng.random() < _GENERIC_SHARE:
            captions.append(draw_caption(GENERIC, -1, -1, rng))
        else:
            class_ = int(rng.choice(len(CLASSES), p=shares[i]))
            captions.append(draw_caption(class_, int(materials[i, class_]), int(crops.families[i]), rng))
    return captions


def _first_views(config: ClipTraining, tasks: list[Future[Path]]) -> ViewFolder:
    """The training views, once enough of them are rendered."""
    folder = ViewFolder(config.cache / "train")
    needed = min(config.first_landmarks, config.landmarks)
    while len(folder.landmarks) < needed:
        finished = all(task.done() for task in tasks)
        folder.refresh()
        if finished and len(folder.landmarks) < needed:
            for task in tasks:
                task.result()  # raises what went wrong
            raise UserError(
                f"{config.cache} holds {len(folder.landmarks)} landmarks, training starts with {needed}: "
                "let it render them (--render-processes 1)"
            )
        time.sleep(0.5)
    return folder


def _validation_views(config: ClipTraining) -> list[Array]:
    if not config.validation_landmarks:
        return []
    folder = config.cache / "validation"
    seeds = SPLITS["validation"][: config.validation_landmarks]
    with background_rendering(folder, seeds, 1, max(config.render_processes, 1)) as tasks:
        for task in tasks:
            task.result()
    return [landmark.views[0] for landmark in ViewFolder(folder).landmarks if landmark.seed in seeds]


if __name__ == "__main__":
    tyro.cli(ClipTraining).main()
