"""Training of the small CLIP that ships with the package, on crops of rendered landmarks with captions.

    python -m lab.clip_training.train_clip --out DIR --cache DIR

About an hour on two CPU cores: one renders landmarks, one trains. --resume continues an interrupted run.
Equal steps and seed and a complete cache of views give equal weights, unless the time limit applies.
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

from lab.clip_training.captions import ABSENT, CLASSES, GENERIC, Caption, draw_caption
from lab.clip_training.contrastive import GENERIC_SHARE, caption_fit, contrastive_loss, in_doubt, patch_loss
from lab.clip_training.crops import (
    Crops,
    augment,
    draw_crops,
    join,
    label_shares,
    main_materials,
    patch_labels,
    soft_labels,
)
from lab.clip_training.photos import store_photos
from lab.clip_training.small_clip import (
    GRID,
    IMAGE_SIZE,
    as_encoder,
    build_clip,
    build_tokenizer,
    load_clip,
    normalize,
    save_clip,
    start_from_principal_components,
)
from lab.clip_training.teacher import score_photos, score_teacher
from lab.clip_training.views import SPLITS, LandmarkViews, ViewFolder, background_rendering
from lang3dxl_ns.common.errors import UserError

_ABSENT_SHARE = 0.08  # of captions that fit no crop
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
    """Time limit: if steps are slow, the schedule is shortened to end in time."""
    batch: int = 128
    """Crops per step."""
    landmarks: int = 1_500
    """Training landmarks."""
    views: int = 2
    """Views of each landmark."""
    first_landmarks: int = 150
    """Landmarks that must be rendered before training starts."""
    render_processes: int = 1
    """Processes that render missing landmarks during training."""
    threads: int = 1
    """CPU threads of the training."""
    validation_landmarks: int = 12
    """Landmarks of the periodic validation score; 0 for none."""
    validation_photos: int = 12
    """Photos of the same score; never trained on."""
    validate_every: int = 1_000
    """Steps between two validation scores."""
    start: Path | None = None
    """CLIP to start from, with its tokenizer; by default weights are random."""
    layers: int = 4
    """Layers of the vision tower; those added to the initial CLIP start as identities."""
    photos: Path | None = None
    """Folder of labeled photos (images/, labels/, classes.json) from which part of every batch is cut."""
    photo_share: float = 0.5
    """Share of the crops cut from photos."""
    peak_rate: float = 1.5e-3
    """Largest learning rate."""
    seed: int = 0
    """Seed of weights, crops and captions."""
    resume: bool = False
    """Resume from the checkpoint in the cache."""
    stop_after: int | None = None
    """Exit at this step with a checkpoint and no model, as if interrupted."""

    def main(self) -> None:
        torch.set_num_threads(self.threads)
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the rendering processes end too
        train(self)


class Trainee(nn.Module):
    """The CLIP in training, with a temporary head that classifies each patch."""

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
    """A training run: its state, progress, and checkpoint."""

    def __init__(self, config: ClipTraining) -> None:
        self.config = config
        torch.manual_seed(config.seed)
        if config.start:
            clip, self.tokenizer = load_clip(config.start, config.layers)
        else:
            self.tokenizer = build_tokenizer(config.seed)
            clip = build_clip(self.tokenizer, config.seed)
        self.trainee = Trainee(clip)
        self.photos: list[LandmarkViews] = []
        self.validation_photos: list[Array] = []
        if config.photos:
            self.photos = store_photos(config.photos, config.cache / "photos", "train")
            kept = (
                store_photos(config.photos, config.cache / "photos", "valid")
                if config.validation_photos
                else []
            )
            chosen = np.linspace(0, len(kept) - 1, min(config.validation_photos, len(kept))).astype(int)
            self.validation_photos = [kept[i].views[0] for i in chosen]
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
        """0 at the start, 1 at the end: of the steps or of the time, whichever comes first."""
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
        """Resume from the checkpoint, or start anew without one."""
        if not self._checkpoint.exists():
            return
        state = torch.load(self._checkpoint, weights_only=True)
        try:
            self.trainee.load_state_dict(state["model"])
        except RuntimeError as error:
            raise UserError(
                f"{self._checkpoint} is from another model: delete it, or train without --resume"
            ) from error
        self.optimizer.load_state_dict(state["optimizer"])
        self.step, self._earlier = state["step"], state["seconds"]

    def start_clock(self) -> None:
        self._started = time.monotonic()


def train(config: ClipTraining) -> None:
    """Train as `config` says and write the model to `config.out`.

    Raises UserError if the checkpoint to resume from is from another model.
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
    _report_scores(run, validation)
    if run.step == config.stop_after:
        return
    save_clip(run.trainee.clip, run.tokenizer, config.out)
    print(
        f"{run.step} steps, {run.step * config.batch} crops, {run.seconds / 60:.0f} min: {config.out}",
        flush=True,
    )


def _fit(run: Run, folder: ViewFolder, validation: list[Array]) -> None:
    """Training steps until the run ends or is stopped."""
    config = run.config
    run.start_clock()
    if run.step == 0 and not config.start:
        crops = draw_crops(
            folder.landmarks, 4 * config.batch, 4, IMAGE_SIZE, np.random.default_rng(config.seed)
        )
        start_from_principal_components(run.trainee.clip, normalize(crops.images.float() / 255))
    saved, mean_loss = time.monotonic(), None
    if config.start and not run.step:
        _report_scores(run, validation)
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
        if run.step % config.validate_every == 0:
            _report_scores(run, validation)
        if time.monotonic() - saved > _SAVE_SECONDS:
            run.save()
            saved = time.monotonic()


def _report_scores(run: Run, validation: list[Array]) -> None:
    """Print the scores on landmarks and photos that are not trained on."""
    encoder = as_encoder(run.trainee.clip, run.tokenizer)
    if validation:
        print(f"step {run.step}: landmarks {score_teacher(encoder, validation)}", flush=True)
    if run.validation_photos:
        print(f"step {run.step}: photos {score_photos(encoder, run.validation_photos)}", flush=True)


def learning_rate(step: int, progress: float, peak: float = 1.5e-3) -> float:
    """Warm-up over 60 steps, then a cosine down to 2 % at progress 1."""
    cosine = 0.51 + 0.49 * np.cos(np.pi * min(progress, 1.0))
    return float(peak * min(1.0, (step + 1) / 60) * cosine)


def _train_step(run: Run, folder: ViewFolder) -> float:
    rng = np.random.default_rng((run.config.seed, run.step))  # of the step: a resumed run draws the same
    crops = _draw_both(run, folder, rng)
    shares, materials = soft_labels(crops), main_materials(crops)
    captions = _draw_captions(crops, shares, materials, rng)
    fits = caption_fit(captions, shares, materials, crops.families)
    doubt = torch.from_numpy(in_doubt(captions, label_shares(crops), fits))
    fit = torch.from_numpy(fits).float()
    classes = torch.tensor([caption.class_ for caption in captions])
    tokens = run.tokenizer([caption.text for caption in captions], padding=True, return_tensors="pt")
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    pixels = normalize(augment(crops.images, torch.from_numpy(crops.inside), generator))

    images, texts, patches = run.trainee(pixels, dict(tokens))
    loss = contrastive_loss(images, texts, fit, classes, run.trainee.clip.logit_scale.exp(), doubt)
    loss = loss + patch_loss(patches, torch.from_numpy(patch_labels(crops, GRID)).float())
    run.optimizer.param_groups[0]["lr"] = learning_rate(run.step, run.progress, run.config.peak_rate)
    run.optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(run.trainee.parameters(), 1.0)
    run.optimizer.step()
    with torch.no_grad():
        run.trainee.clip.logit_scale.clamp_(max=float(np.log(30.0)))
    return loss.item()


def _draw_both(run: Run, folder: ViewFolder, rng: np.random.Generator) -> Crops:
    """Crops of landmarks and, where there are any, of labeled photos."""
    count, photos = run.config.batch, run.photos
    if not photos:
        return draw_crops(folder.landmarks, count, 4, IMAGE_SIZE, rng)
    of_photos = round(count * run.config.photo_share)
    halves = (folder.landmarks, count - of_photos), (photos, of_photos)
    return join([draw_crops(views, half, 4, IMAGE_SIZE, rng) for views, half in halves])


def _draw_captions(
    crops: Crops, shares: Float[Array, "n k"], materials: Int[Array, "n k"], rng: np.random.Generator
) -> list[Caption]:
    """Captions of some of the crops, each of a class drawn from the crop's shares, or generic."""
    captions = []
    for i in rng.choice(len(shares), min(_CAPTIONS, len(shares)), replace=False):
        if rng.random() < GENERIC_SHARE:
            captions.append(draw_caption(GENERIC, -1, -1, rng))
        elif rng.random() < _ABSENT_SHARE or not shares[i].any():
            captions.append(draw_caption(ABSENT, -1, -1, rng))
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
