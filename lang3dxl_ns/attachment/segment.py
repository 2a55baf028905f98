"""Words taught by a segmenter, whose masks of the photos are lifted to the Gaussians by votes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import torch
from jaxtyping import Bool
from torch import Tensor

from lang3dxl_ns.common.console import say, tracked
from lang3dxl_ns.preparation.segmentation import TextSegmenter
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.rendering import composite
from lang3dxl_ns.rendering.gathering import Composite, Pixels, gather
from lang3dxl_ns.scene.camera import Camera, resized
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.words.learn_word import MARK_SIDE
from lang3dxl_ns.words.taught_words import Example

_SIDE = 800
"""Longer side of the photos that are segmented, pixels."""
_EXAMPLES = 12
"""Largest number of photos that teach the word. Those that show most of it are chosen."""
_LEAST, _MOST = 1e-3, 0.9
"""Smallest and largest share of the scene's pixels that the word may fill in a photo that teaches it."""


def segmented(
    scene: Scene, word: str, segmenter: TextSegmenter, photos: Sequence[Photo], cameras: Mapping[str, Camera]
) -> Scene:
    """Teach a scene a word by a segmenter; if that finds nothing, say so and return the same scene. Each
    photo votes about the Gaussians that it shows, and the word is learned from those with a majority, as from
    marks by a person. `cameras` holds the photos' cameras, at the files' resolution, in the scene's frame."""
    masks: dict[str, Bool[Tensor, "h w"]] = {}

    def views() -> Iterator[tuple[Composite, Pixels]]:
        for photo in tracked(photos, f"looking for {word}"):
            masks[photo.name] = segmenter.segment(photo.read_file(_SIDE), [word])
            marked = photo.undistort_labels(masks[photo.name].int()) == 1
            camera, values = resized(cameras[photo.name], _SIDE), marked[..., None].to(like)
            foreground = photo.read_mask(camera.width / photo.width)
            drawn = partial(composite, scene.splats, camera)
            yield drawn, Pixels.of([values], (camera.height, camera.width), foreground)

    like = scene.splats.means
    chosen = gather(len(scene.splats), views(), 1, like)[0][:, 0].to(like) > 0.5
    found = [photo for photo in photos if masks[photo.name].any()]
    shares = {photo.name: _share(scene, photo, cameras[photo.name], chosen) for photo in found}
    teaching = [name for name, share in shares.items() if _LEAST <= share <= _MOST]
    if not teaching:
        say(f"the segmenter finds no {word} that the photos agree on: the scene isn't taught this word")
        return scene
    best = sorted(teaching, key=lambda name: -shares[name])[:_EXAMPLES]
    say(f"{word}: {int(chosen.sum()):,} Gaussians by the votes of {len(photos)} photos")
    return scene.teach(word, [Example(name, masks[name].numpy()) for name in best], selection=chosen)


def _share(scene: Scene, photo: Photo, camera: Camera, chosen: Bool[Tensor, " n"]) -> float:
    """Compute the share of the scene's pixels in a photo's foreground that the chosen Gaussians fill."""
    small = resized(camera, MARK_SIDE)
    both = torch.stack([chosen, torch.ones_like(chosen)], dim=1).to(scene.splats.means)
    drawn = composite(scene.splats, small, both)
    foreground = photo.read_mask(small.width / photo.width)
    keep = Pixels.of([drawn], (small.height, small.width), foreground).foreground
    filled = (drawn * keep[..., None]).flatten(0, -2).sum(0)
    return float(filled[0] / filled[1].clamp_min(1e-6))
