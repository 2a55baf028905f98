"""Training of the small CLIP's patch head, which reads patch tokens as texts are read.

    python -m lab.clip_training.train_patches --cache DIR --photos FACADES --out lang3dxl_ns/demo/clip

Both towers are frozen. The head sees every patch in windows of several sizes. Most of the time goes to
reading views (half a second each); a landmark is rendered in a third of a second, and the fit takes a quarter
of an hour.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float, UInt8
from numpy import ndarray as Array
from safetensors.torch import save_file
from torch import Tensor

from lab.clip_training.captions import CLASSES, MAY_BE, words_of
from lab.clip_training.crops import augment, class_map
from lab.clip_training.photos import store_photos
from lab.clip_training.small_clip import GRID, PATCH, as_encoder, load_clip, normalize
from lab.clip_training.views import COLOR, ELEMENT, PART, SPLITS, ViewFolder, background_rendering
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.dense_map import build_dense_map, nested_grids
from lang3dxl_ns.preparation.families import FILE, PatchHead, patch_tokens, read_patch_head
from lang3dxl_ns.preparation.model_files import BUILTIN, CLIP_OPTION, find_model

SIDES = (20, 90)
"""Range of the smallest windows' sides in pixels of a stored view, as in scenes of 480 to 1,024 pixels."""
SIZES = 5
"""Number of window sizes; the largest is 16 times as wide as the smallest, often the whole view."""
HIDDEN = 256
"""Width of the head's hidden layer."""
PHOTO_SHARE = 0.1
"""Weight of the photos in the loss."""
_PER_VIEW = 250  # patches kept of a view
_AT_ONCE = 256  # windows encoded at once
_BATCH = 2_048
_RATE, _DECAY = 2e-3, 1e-4
_SCALE = 10.0  # scale of the cosines in the softmax; a learned one grows, which harms domes and portals
_DOUBT = 0.12  # share of a patch that may show a class without its label; above it the loss skips the class
_LEAST_KNOWN = 0.3  # labeled share of a patch that is used
_LEAST_SEEN = (
    30  # number of patches below which a class of a view is as likely to be drawn as one with so many
)
Patches = tuple[Float[Tensor, "sizes n d"], Float[Tensor, "n k"]]
"""Unit patch tokens, coarse to fine, and the share of every class in each patch."""
View = UInt8[Array, "6 h w"]


@dataclass(kw_only=True)
class PatchTraining:
    """Train the patch head."""

    out: Path
    """Folder in which the head is saved."""
    cache: Path
    """Folder for rendered views."""
    photos: Path | None = None
    """Folder of labeled photos; none without it."""
    landmarks: int = 1_942
    """Number of training landmarks, with two views each."""
    most_photos: int = 800
    """Most pictures of photos, each of which counts as taken and by daylight."""
    steps: int = 8_000
    """Training steps, each with 2,048 patches from landmarks and as many from photos."""
    beside: Path | None = None
    """Folder of a CLIP whose head is averaged with the new one: two fits err less than one."""
    processes: int = 1
    """Processes that render landmarks."""
    seed: int = 0
    """Random seed of patches and batches."""

    def main(self) -> None:
        torch.manual_seed(self.seed)
        torch.set_num_threads(1)
        clip, tokenizer = load_clip(find_model(BUILTIN, CLIP_OPTION).folder, 0)
        clip.eval().requires_grad_(False)
        seeds = SPLITS["train"][100 : 100 + self.landmarks]
        with background_rendering(self.cache / "patches", seeds, 2, self.processes) as tasks:
            for task in tasks:
                task.result()
        landmarks = ViewFolder(self.cache / "patches").landmarks[: self.landmarks]
        photos = store_photos(self.photos, self.cache / "photos", "train") if self.photos else []
        rng = np.random.default_rng(self.seed)
        worlds = [(read_patches(clip, [v for m in landmarks for v in m.views], rng), 1.0)]
        if photos:
            views = [view for photo in photos for view in photo.views]
            chosen = [views[i] for i in rng.permutation(len(views))[: self.most_photos]]
            of_photos = read_patches(clip, chosen, rng)
            worlds = [(worlds[0][0], 1 - PHOTO_SHARE), (of_photos, PHOTO_SHARE)]
        encoder = as_encoder(clip, tokenizer)
        texts = torch.stack([_unit(_unit(encoder.encode_texts(words_of(k)[:2])).mean(0)) for k in _classes()])
        head = PatchHead(worlds[0][0][0].shape[-1], texts.shape[1], SIZES, HIDDEN)
        fit(head, worlds, texts, self.steps)
        if self.beside is not None:
            other = read_patch_head(self.beside, "cpu")
            if other is None:
                raise UserError(
                    f"{self.beside} has no {FILE} to average with: name the folder of a CLIP that has one"
                )
            head = averaged(other, head)
        self.out.mkdir(parents=True, exist_ok=True)
        save_file({name: tensor.half() for name, tensor in head.state_dict().items()}, self.out / FILE)


def _classes() -> range:
    return range(len(CLASSES))


def _unit(x: Tensor) -> Tensor:
    return F.normalize(x, dim=-1)


def read_patches(clip: Any, views: Sequence[View], rng: np.random.Generator) -> Patches:
    """Compute the head's inputs at random patches of views, and the share of every class in each. Views are
    mirrored, their light and sharpness varied, and read at random sizes."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    tokens, shares, start = [], [], time.monotonic()
    for number, view in enumerate(views):
        found = _read_view(clip, view if rng.random() < 0.5 else view[..., ::-1], rng, generator)
        tokens.append(found[0])
        shares.append(found[1])
        if (number + 1) % 100 == 0:
            left = (time.monotonic() - start) / (number + 1) * (len(views) - number - 1)
            print(f"{number + 1} of {len(views)} views read, {left / 60:.0f} min left", flush=True)
    return torch.cat(tokens, 1), torch.cat(shares)


def _read_view(clip: Any, view: View, rng: np.random.Generator, generator: torch.Generator) -> Patches:
    colors = torch.from_numpy(view[COLOR].copy())[None]
    everywhere = torch.ones(1, 1, 1, dtype=torch.bool)
    photo = augment(colors, everywhere, generator)[0].permute(1, 2, 0)
    side = round(float(np.exp(rng.uniform(*np.log(SIDES)))))
    height, width = photo.shape[:2]
    grids = nested_grids(height, width, GRID, side, SIZES)

    def encode(windows: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n rows columns d"]:
        return patch_tokens(clip, normalize(windows)).unflatten(1, (GRID, GRID))

    maps = build_dense_map(photo, grids, encode, GRID, PATCH, _AT_ONCE, lambda sizes: sizes)
    labels = torch.from_numpy(class_map(view[PART], view[ELEMENT]).astype(np.int64))
    shown = F.one_hot(labels, len(CLASSES) + 1)[..., :-1].permute(2, 0, 1)[None].float()
    shares = F.interpolate(shown, grids[-1], mode="area")[0].permute(1, 2, 0).flatten(0, 1)
    most = shares.argmax(1)
    known = shares.sum(1) > _LEAST_KNOWN
    counts = most[known].bincount(minlength=len(CLASSES))
    likely = known * (counts[most] + _LEAST_SEEN).rsqrt()
    chosen = torch.multinomial(likely, min(_PER_VIEW, int(known.sum())), generator=generator)
    return maps.flatten(1, 2)[:, chosen], shares[chosen]


def fit(
    head: PatchHead, worlds: Sequence[tuple[Patches, float]], texts: Float[Tensor, "k c"], steps: int
) -> None:
    """Fit the head to map tokens to the texts of the classes that patches show, by soft cross entropy in
    which classes weigh 1 / √frequency. Classes that may be there without a label are ignored.

    Args:
        head: the head, which is trained in place.
        worlds: the patches of landmarks and of photos, each with its weight in the loss.
        texts: unit vector of every class.
        steps: number of optimizer steps.
    """
    optimizer = torch.optim.AdamW(head.parameters(), lr=_RATE, weight_decay=_DECAY)
    may_be = torch.from_numpy(MAY_BE[: len(CLASSES)]).float()
    found = [(*world, share, world[1].sum(0)) for world, share in worlds]
    head.train()
    mean = 0.0
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = _RATE * (1 - step / steps)
        loss = torch.zeros(())
        for tokens, shares, share, number in found:
            batch = torch.randint(len(shares), (_BATCH,))
            shown = shares[batch]
            logits = _SCALE * _unit(head(tokens[:, batch])) @ texts.T
            hidden = ((shown @ may_be > _DOUBT) & (shown == 0)) | (number == 0)
            wanted = shown * (number.clamp_min(50) / number.sum()).rsqrt() * (number > 0)
            fits = (wanted * logits.masked_fill(hidden, -1e4).log_softmax(1)).sum() / wanted.sum()
            loss = loss - share * fits
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        mean = loss.item() if not step else mean + 0.02 * (loss.item() - mean)
        if (step + 1) % 500 == 0:
            print(f"step {step + 1}: loss {mean:.3f}", flush=True)
    head.eval()


def averaged(*heads: PatchHead) -> PatchHead:
    """Build the head whose output is the mean of those of `heads`; its hidden layer is all of theirs."""
    first = heads[0]
    width, channels = first.direct.in_features, first.direct.out_features
    mean = PatchHead(width, channels, first.sizes, sum(head.inner.out_features for head in heads))
    with torch.no_grad():
        for name in ("weight", "bias"):
            parts = [getattr(head.direct, name) for head in heads]
            getattr(mean.direct, name).copy_(torch.stack(parts).mean(0))
        # The norms' scales and offsets move into the layers that follow them.
        mean.inner.weight.copy_(torch.cat([head.inner.weight * head.norm.weight for head in heads]))
        offsets = [head.inner.bias + head.inner.weight @ head.norm.bias for head in heads]
        mean.inner.bias.copy_(torch.cat(offsets))
        mean.outer.weight.copy_(torch.cat([head.outer.weight for head in heads], 1) / len(heads))
        mean.outer.bias.copy_(torch.stack([head.outer.bias for head in heads]).mean(0))
    return mean.eval()


if __name__ == "__main__":
    tyro.cli(PatchTraining).main()
