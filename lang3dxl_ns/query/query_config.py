"""Settings of queries."""

from __future__ import annotations

from dataclasses import dataclass, field

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.query.relevancy import TEMPERATURE
from lang3dxl_ns.query.text import TextConfig


@showing("threshold", "size", "foreground")
@dataclass
class QueryConfig:
    """Settings of queries."""

    text: TextConfig = field(default_factory=TextConfig)
    """Synonyms, their combination, canonical phrases."""
    temperature: float = TEMPERATURE
    """Softmax temperature of the relevancy, for an encoder whose cosines spread like the built-in CLIP's;
    those of others are scaled. Changes neither the ranking of Gaussians nor what matches."""
    threshold: float | None = None
    """Relevancy above which Gaussians match (default: what stands out in the scene, at most 0.5)."""
    min_alpha: float = 0.3
    """Coverage below which a pixel can't match."""
    foreground: str = ""
    """Restrict matches to what this prompt finds, such as `building`; for views without a mask. The view of a
    photo with a foreground mask is always restricted to it."""
    size: int | None = None
    """Longer side of pictures in pixels (default: the photo's own, at most 1920)."""
    views: int = 100
    """Number of training views, evenly spread, that `find` chooses from."""
    view_side: int = 256
    """Pixels of their longer side, for measuring which Gaussians they show."""

    def __post_init__(self) -> None:
        """Raises UserError for invalid options."""
        check_numbers(self, _BOUNDS)


_BOUNDS = {
    "temperature": (1e-3, 1e4),
    "threshold": (0, 1),
    "min_alpha": (0, 1),
    "size": (1, 1 << 16),
    "views": (1, 1e6),
    "view_side": (8, 8192),
}
