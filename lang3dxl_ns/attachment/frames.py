"""Search for the frame of a splat: renderings at the photos' cameras are compared with the photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.attachment.known_frames import Similarity, known_frames, registered_frames
from lang3dxl_ns.common.console import progress, tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.match import as_bytes
from lang3dxl_ns.rendering import Splats, rasterize, render
from lang3dxl_ns.scene.camera import Camera, resized
from lang3dxl_ns.scene.capture import Capture
from lang3dxl_ns.scene.colmap import TrackedPhoto

FITS, FITS_FEW = 0.5, 0.65
"""Correlation of renderings with their photos above which a frame is right, with many photos and with fewer
than `_FEW`, to which a frame can be fitted by chance: wrong ones reach 0.3, and with three photos 0.55."""
_CLOSE = 0.75
"""Correlation from which a frame is not refined, and no other one is tried."""
_PROMISING = 0.15
"""Correlation below which a frame is not worth refining."""
_SMALL, _LARGE = 64, 128
"""Longer sides of the compared pictures, pixels."""
_FEW, _MANY = 5, 12
"""Numbers of photos in the first comparison, and in the last."""
_REFINED = 3
"""Largest number of frames that are refined."""
_ROUNDS = ((48, 40), (96, 40))
"""Rounds of refinement: longer side in pixels, and steps at it."""
_MOST = 200_000
"""Largest number of Gaussians that refinement renders, which it does hundreds of times."""
_RATE = 4e-3
"""Adam's learning rate, in radians and fractions of the scene's size."""
_COVERED = 0.05
"""Smallest share of a photo that the splat must cover."""
_SEES = 0.05
"""Opacity above which registration counts a Gaussian as part of the shape."""


@dataclass(frozen=True)
class Fit:
    """Frame of a splat, and how well renderings in it agree with the photos."""

    name: str
    similarity: Similarity
    score: float
    """Mean correlation of brightness, −1…1."""
    photos: int
    """Number of photos that were compared."""

    @property
    def fits(self) -> bool:
        """Whether the frame is right."""
        return self.score >= (FITS if self.photos >= _FEW else FITS_FEW)


def camera_in(similarity: Similarity | Float[Tensor, "4 4"], tracked: TrackedPhoto) -> Camera:
    """Build a photo's camera in the splat's frame. The lens must be the undistorted photo's."""
    whole = torch.as_tensor(similarity, dtype=torch.float64)
    pose = torch.from_numpy(np.vstack([tracked.camera_from_world, [0, 0, 0, 1]])).double()
    view = pose @ whole.inverse()
    scale = whole[:3, :3].det().pow(1 / 3)
    return tracked.lens.camera(torch.cat([scale * view[:3], view[3:]]).float())  # the axes keep unit length


def find_frame(splats: Splats, collection: Capture, splat: Path) -> Fit:
    """Find the frame in which renderings at the photos' cameras look like the photos.

    The frames that programs use are tried first (`known_frames`, by the splat's file), then those from the
    scene's shape. The best of them are refined by descent on the correlation. The result may be wrong, which
    `Fit.fits` shows.
    """
    small, large = _compared(collection, _FEW, _SMALL), _compared(collection, _MANY, _LARGE)
    best = _best(splats, small, known_frames(collection.reconstruction, splat))
    if best[0].score < FITS:
        seen = splats.opacities > _SEES
        means = splats.means[seen].double().cpu().numpy()
        shaped = registered_frames(collection.reconstruction.points, means)
        best = sorted([*best, *_best(splats, small, shaped)], key=lambda fit: fit.score, reverse=True)
    checked = [_fit(splats, large, fit.name, fit.similarity) for fit in best[:_REFINED]]
    found = max(checked, key=lambda fit: fit.score)
    if found.score >= _CLOSE:
        return found
    worth = [found] if found.fits else [f for f in checked if f.score >= min(_PROMISING, found.score)]
    thinned = splats.thinned(_MOST)
    with progress("refining the frame", len(worth) * sum(steps for _, steps in _ROUNDS)) as advance:
        for fit in worth:
            refined = fit.similarity
            for side, steps in _ROUNDS:
                refined = _refined(thinned, _compared(collection, _FEW, side), refined, steps, advance)
            again = _fit(splats, large, f"{fit.name}, refined", refined)
            found = max(found, again, key=lambda fit: fit.score)
    return found


def _best(splats: Splats, photos: Sequence[_Compared], frames: Mapping[str, Similarity]) -> list[Fit]:
    fits = []
    for name, frame in tracked(frames.items(), "comparing with the photos"):
        fits.append(_fit(splats, photos, name, frame))
        if fits[-1].score >= _CLOSE:
            break
    return sorted(fits, key=lambda fit: fit.score, reverse=True)


@dataclass(frozen=True)
class _Compared:
    """Photo to compare, small and gray."""

    tracked: TrackedPhoto
    gray: Float[Tensor, "h w"]
    mask: Bool[Tensor, "h w"]

    def beside(
        self, splats: Splats, similarity: Similarity | Float[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
        """Return a rendering at the photo's camera, the photo, and where the two can be compared: in what the
        splat covers, without its edges, where the background that it lacks shows through."""
        camera = camera_in(similarity, self.tracked)
        colors = splats.colors(camera.position.detach()).mean(1, keepdim=True)
        seen = splats.seen_from(camera)
        raster = rasterize(seen, camera, colors, antialiased=splats.antialiased)
        drawn, alpha = raster.image[..., 0], raster.alpha[..., 0].detach()
        covered = -F.max_pool2d(-alpha[None], 3, 1, 1)[0] > 0.8
        return drawn, self.gray.to(drawn), self.mask.to(drawn.device) & covered


def _compared(collection: Capture, count: int, side: int) -> list[_Compared]:
    """Read some photos, evenly spread from the first to the last, at a longer side of `side` pixels, without
    those that are damaged, and without damaged masks. Raises UserError if all are."""
    found, last, trouble = list[_Compared](), len(collection.photos) - 1, None
    for i in np.linspace(0, last, min(count, last + 1)).round().astype(int):
        photo = collection.photos[i].at_most(side)
        try:
            gray, mask = photo.read().mean(-1), None
        except UserError as error:
            trouble = error
            continue
        with suppress(UserError):
            mask = photo.read_mask()
        tracked = collection.reconstruction.photos[photo.name].resized(photo.width, photo.height)
        mask = torch.ones_like(gray, dtype=torch.bool) if mask is None else mask
        found.append(_Compared(tracked, gray, mask))
    if trouble is not None and not found:
        raise trouble
    return found


@torch.no_grad()
def _fit(splats: Splats, photos: Sequence[_Compared], name: str, similarity: Similarity) -> Fit:
    scores = [float(_correlation(*photo.beside(splats, similarity))) for photo in photos]
    return Fit(name, similarity, float(np.mean(scores)), len(photos))


def _refined(
    splats: Splats, photos: Sequence[_Compared], start: Similarity, steps: int, advance: Callable[[], None]
) -> Similarity:
    """Refine the similarity by some steps of Adam on rotation, translation and scale."""
    centers = np.array([photo.tracked.center for photo in photos])
    middle = torch.from_numpy(start[:3, :3] @ np.median(centers, axis=0) + start[:3, 3])
    seen = splats.means[splats.opacities > _SEES].double().cpu()
    size = float((seen - seen.median(0).values).norm(dim=1).median()) if len(seen) else 1.0
    values = torch.zeros(7, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([values], lr=_RATE)
    best, lowest = start, np.inf
    for _ in range(steps):
        whole = _similarity(values, middle, size) @ torch.from_numpy(start)
        with torch.enable_grad():
            losses = [1 - _correlation(*photo.beside(splats, whole)) for photo in photos]
            loss = torch.stack(losses).mean()
            optimizer.zero_grad()
            loss.backward()
        if float(loss.detach()) < lowest:
            best, lowest = whole.detach().numpy(), float(loss.detach())
        optimizer.step()
        advance()
    return best


def _similarity(values: Float[Tensor, "7"], middle: Float[Tensor, "3"], size: float) -> Float[Tensor, "4 4"]:
    """Combine a rotation about `middle` (radians), a scale (logarithm) and a translation (in sizes)."""
    x, y, z = values[:3]
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    turn = values[6].exp() * torch.linalg.matrix_exp(skew)
    shift = middle + size * values[3:6] - turn @ middle
    top = torch.cat([turn, shift[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0, 0, 1]])])


def _correlation(
    a: Float[Tensor, "h w"], b: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Compute Pearson's correlation over the mask; 0 where one picture is flat, or the mask is small."""
    if float(mask.float().mean()) < _COVERED:
        return a.sum() * 0
    a, b = a[mask] - a[mask].mean(), b[mask] - b[mask].mean()
    return (a * b).sum() / (a.square().sum() * b.square().sum()).clamp_min(1e-12).sqrt()


def side_by_side(splats: Splats, collection: Capture, fit: Fit) -> UInt8[Array, "h w 3"]:
    """Draw a photo beside the rendering at its camera, for a person to compare."""
    photo = collection.photos[len(collection.photos) // 2]
    camera = camera_in(fit.similarity, collection.reconstruction.photos[photo.name])
    camera = resized(camera, 640)
    rendering = as_bytes(render(splats, camera).rgb)
    read = photo.read_uint8(camera.width / photo.width).numpy()
    rows, columns = min(len(read), len(rendering)), min(read.shape[1], rendering.shape[1])
    return np.concatenate([read[:rows, :columns], rendering[:rows, :columns]], axis=1)
