"""Training of the small CLIP's patch head: a linear map from its patch tokens to the space of its texts.

    python -m lab.clip_training.train_patches --cache DIR --photos FACADES --out lang3dxl_ns/demo/clip

Both towers are frozen. A patch token sees the whole crop and stands for a sixteenth of its area, so a map of
tokens is four times as fine as one of crop embeddings. Training takes about five minutes on one core.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float
from safetensors.torch import save_file
from torch import Tensor

from lab.clip_training.captions import CLASSES, MAY_BE, words_of
from lab.clip_training.crops import augment, draw_crops, patch_labels
from lab.clip_training.photos import store_photos
from lab.clip_training.small_clip import GRID, IMAGE_SIZE, as_encoder, load_clip, normalize
from lab.clip_training.views import SPLITS, LandmarkViews, ViewFolder, background_rendering
from lang3dxl_ns.preparation.model_files import BUILTIN, CLIP_OPTION, find_model
from lang3dxl_ns.preparation.patch_head import FILE

SIDES = (26, 140)
"""Range of the crops' sides in pixels of a stored view, the same as for a scene's training photos."""
PHOTO_SHARE = 0.1
"""Weight of the photos in the loss. It is small, because a linear head cannot serve both worlds equally."""
_AT_ONCE = 256
_SCALE = 10.0  # scale of the cosines in the softmax; a learned one grows, which harms domes and portals
World = tuple[Float[Tensor, "n d"], Float[Tensor, "n k"]]
"""Patch tokens, and the share of every class in each patch."""
_DOUBT = 0.12  # share of a patch that may show a class without its label; above it the loss skips the class


@dataclass(kw_only=True)
class PatchTraining:
    """Train the patch head."""

    out: Path
    """Folder in which the head is saved."""
    cache: Path
    """Folder for rendered views."""
    photos: Path | None = None
    """Folder of labeled photos, which give a quarter as many crops as landmarks; none without it."""
    landmarks: int = 100
    """Number of training landmarks, with two views each."""
    crops: int = 26_000
    """Number of crops from landmarks to train on."""
    steps: int = 900
    """Training steps, each with 2,048 patches from landmarks and as many from photos."""
    seed: int = 0
    """Random seed of crops and batches."""

    def main(self) -> None:
        torch.manual_seed(self.seed)
        torch.set_num_threads(1)
        clip, tokenizer = load_clip(find_model(BUILTIN, CLIP_OPTION).folder, 0)
        clip.eval().requires_grad_(False)
        seeds = SPLITS["train"][100 : 100 + self.landmarks]
        with background_rendering(self.cache / "patches", seeds, 2, 1) as tasks:
            for task in tasks:
                task.result()
        landmarks = ViewFolder(self.cache / "patches").landmarks
        photos = store_photos(self.photos, self.cache / "photos", "train") if self.photos else []
        worlds = [(read_patches(clip, landmarks, self.crops, self.seed), 1.0)]
        if photos:
            of_photos = read_patches(clip, photos, self.crops // 4, self.seed + 1)
            worlds = [(worlds[0][0], 1 - PHOTO_SHARE), (of_photos, PHOTO_SHARE)]
        encoder = as_encoder(clip, tokenizer)
        texts = torch.stack([_unit(_unit(encoder.encode_texts(words_of(k)[:2])).mean(0)) for k in _classes()])
        head = fit(worlds, texts, clip.visual_projection.weight, self.steps)
        self.out.mkdir(parents=True, exist_ok=True)
        save_file(head, self.out / FILE)


def _classes() -> range:
    return range(len(CLASSES))


def _unit(x: Tensor) -> Tensor:
    return F.normalize(x, dim=-1)


@torch.no_grad()
def read_patches(clip: Any, views: list[LandmarkViews], count: int, seed: int) -> World:
    """Compute the patch tokens of random crops, the head's inputs, and the share of every class in each."""
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    tokens, shares = [], []
    for _ in range(count // _AT_ONCE):
        crops = draw_crops(views, _AT_ONCE, 4, IMAGE_SIZE, rng, SIDES)
        pixels = normalize(augment(crops.images, torch.from_numpy(crops.inside), generator))
        hidden = clip.vision_model(pixel_values=pixels).last_hidden_state[:, 1:]
        tokens.append(clip.vision_model.post_layernorm(hidden).flatten(0, 1))
        shares.append(torch.from_numpy(patch_labels(crops, GRID)).float().flatten(0, 1))
    return torch.cat(tokens), torch.cat(shares)


def fit(
    worlds: list[tuple[World, float]],
    texts: Float[Tensor, "k c"],
    start: Float[Tensor, "c d"],
    steps: int,
) -> dict[str, Tensor]:
    """Fit a weight and a bias that map tokens to the texts of the classes that patches show, by soft cross
    entropy in which classes weigh 1 / √frequency. Classes that may be there without a label are ignored.

    Args:
        worlds: the patches of landmarks and of photos, each with its weight in the loss.
        texts: unit vector of every class.
        start: initial weight, the CLIP's own projection.
        steps: number of optimizer steps.
    """
    weight, bias = start.clone().requires_grad_(), torch.zeros(len(start), requires_grad=True)
    optimizer = torch.optim.Adam([weight, bias], lr=2e-3)
    may_be = torch.from_numpy(MAY_BE[: len(CLASSES)]).float()
    found = [(*world, share, world[1].sum(0)) for world, share in worlds]
    mean = 0.0
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = 2e-3 * (1 - step / steps)
        loss = torch.zeros(())
        for tokens, shares, share, number in found:
            batch = torch.randint(len(tokens), (2_048,))
            shown = shares[batch]
            logits = _SCALE * _unit(tokens[batch] @ weight.T + bias) @ texts.T
            hidden = ((shown @ may_be > _DOUBT) & (shown == 0)) | (number == 0)
            wanted = shown * (number.clamp_min(50) / number.sum()).rsqrt() * (number > 0)
            fits = (wanted * logits.masked_fill(hidden, -1e4).log_softmax(1)).sum() / wanted.sum()
            loss = loss - share * fits
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        mean = loss.item() if not step else mean + 0.02 * (loss.item() - mean)
        if (step + 1) % 100 == 0:
            print(f"step {step + 1}: loss {mean:.3f}", flush=True)
    return {"weight": weight.detach(), "bias": bias.detach()}


if __name__ == "__main__":
    tyro.cli(PatchTraining).main()
