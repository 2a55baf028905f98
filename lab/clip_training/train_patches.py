"""Training of the patch head of the small CLIP: a linear reading of its patch tokens as texts are read.

    python -m lab.clip_training.train_patches --cache DIR --photos FACADES --out lang3dxl_ns/demo/clip

Both towers stay as they are. A token of a crop sees all of it, and stands for a sixteenth of it: its reading
is four times as fine as the crop's own embedding. About three minutes on one core.
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
"""Range of the crops' sides in pixels of a stored view: those that training photos are read at."""
PHOTO_SHARE = 0.1
"""Share of the photos in the loss: a linear head can't serve both worlds equally."""
_AT_ONCE = 256
_SCALE = 10.0  # of the cosines in the softmax: a learned one grows, and domes and portals lose
World = tuple[Float[Tensor, "n d"], Float[Tensor, "n k"]]
"""Tokens, and the share of every class in each patch."""
_DOUBT = 0.12  # share of a patch that may show a class unnamed, above which the class is left out of the loss


@dataclass(kw_only=True)
class PatchTraining:
    """Train the patch head."""

    out: Path
    """Folder for the head's file."""
    cache: Path
    """Folder for rendered views."""
    photos: Path | None = None
    """Folder of labeled photos: a quarter as many crops are cut from them."""
    landmarks: int = 100
    """Training landmarks, two views each."""
    crops: int = 26_000
    """Crops of landmarks to fit on."""
    steps: int = 900
    """Training steps, of 2,048 patches of each world."""
    seed: int = 0
    """Seed of crops and batches."""

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
    """Tokens of random crops' patches, as the head reads them, and the share of every class in each patch."""
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
    """Weight and bias whose readings fit the texts of what patches show: soft cross entropy, rare classes
    weighted by the root of their rarity. Classes that a patch may show unnamed don't count against it.

    Args:
        worlds: patches of landmarks, of photos, each with its share of the loss.
        texts: a vector for every class.
        start: the weight to begin with, the CLIP's own projection.
        steps: of the optimizer.
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
