"""Evaluated photos: their figures, and the pictures behind them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from torch import Tensor

from lang3dxl_ns.evaluation.scores import Maps


@dataclass
class EvaluatedPhoto:
    """Evaluated photo with its figures and the pictures behind them."""

    name: str
    metrics: dict[str, float]
    """Figures of the photo: psnr etc., `render_seconds`, and with appearance `half_psnr` etc. With ground
    truth also `query_seconds`, and `ap_{category}` etc. with the prefixes of `evaluation.aggregate`."""
    images: dict[str, Tensor]
    """Pictures by name: `img` (photo beside rendering, [H, 2W, 3]), with semantics `bottleneck`, and with
    appearance `fitted`, the rendering in the look of the half-image protocol."""
    maps: Maps
    """Relevancy by category, as queries show it, at the size of scoring; empty without ground truth."""
    masked: bool = False
    """Whether the maps are restricted to a foreground mask."""

    def write_pictures(self, folder: Path) -> None:
        """Write every picture to `folder` as a JPEG named after the photo."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, image in self.images.items():
            pixels = (image.clamp(0, 1) * 255).byte().cpu().numpy()
            Image.fromarray(pixels).save(folder / f"{self.name.replace('/', '_')}.{name}.jpg")
