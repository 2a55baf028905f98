"""`python -m lab.clip_training.known_world`: statistics of what the built-in CLIP was trained on, for
`lang3dxl_ns/query/trust.py`. They are made from renderings of training landmarks alone."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import tyro
from jaxtyping import Float, UInt8
from numpy import ndarray as Array
from torch import Tensor

from lab.clip_training.views import SPLITS
from lab.landmark.landmark import Landmark
from lab.landmark.photography import take_photo
from lab.landmark.scene_writer import photo_view
from lang3dxl_ns.preparation.dense_map import build_dense_map, nested_grids
from lang3dxl_ns.preparation.encoders import ImageTextEncoder, load_image_text_encoder, patch_reading
from lang3dxl_ns.query.trust import KNOWN_WORLD

FAMILIES = ("cathedral", "mosque", "hall")
SIDES = (20, 28, 40)
"""Sides in pixels of the smallest windows, one per photo of a landmark."""


@dataclass
class KnownWorld:
    """Measure mean and inverse covariance of the features of training landmarks."""

    landmarks: int = 12
    patches: int = 400
    """Number of patches drawn from each photo."""

    def main(self) -> None:
        from safetensors.torch import save_file

        clip, generator = load_image_text_encoder("builtin", "cpu"), torch.Generator().manual_seed(0)
        parts = []
        for number, seed in enumerate(SPLITS["train"][: self.landmarks]):
            landmark = Landmark.from_seed(seed, FAMILIES[number % len(FAMILIES)])
            for photo, side in enumerate(SIDES, start=1):
                view, width, height = photo_view(landmark, seed, photo, True, (480, 360))
                features = patch_features(clip, take_photo(landmark, view, width, height).image, side)
                parts.append(features[torch.randperm(len(features), generator=generator)[: self.patches]])
            print(f"landmark {number + 1} of {self.landmarks}", flush=True)
        features = torch.nn.functional.normalize(torch.cat(parts), dim=1)
        covariance = torch.cov(features.T.double())
        covariance += 1e-3 * covariance.diagonal().mean() * torch.eye(len(covariance))
        tensors = {"mean": features.mean(0), "precision": torch.linalg.inv(covariance).float().contiguous()}
        save_file(tensors, KNOWN_WORLD, {"clip": clip.identity})


def patch_features(clip: ImageTextEncoder, image: UInt8[Array, "h w 3"], side: int) -> Float[Tensor, "p c"]:
    """Compute a photo's features as targets have them, with smallest windows of `side` pixels."""
    reading = patch_reading("builtin", "auto")
    assert reading is not None and reading.sizes is not None
    photo = clip.in_known_light(torch.from_numpy(image).float() / 255)
    height, width = photo.shape[:2]
    grids = nested_grids(height, width, reading.tokens, side, reading.sizes)
    windows = 8
    map_of = build_dense_map(
        photo, grids, clip.encode_patches, reading.tokens, clip.patch_size, windows, clip.join_sizes
    )
    return map_of.flatten(0, 1)


if __name__ == "__main__":
    tyro.cli(KnownWorld).main()
