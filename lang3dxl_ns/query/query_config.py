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
    """How prompts become vectors: synonyms, their combination, and negatives."""
    temperature: float = TEMPERATURE
    """Softmax temperature of the relevancy, for an encoder whose cosines spread like the built-in CLIP's;
    cosines of other encoders are scaled. It changes neither the ranking of Gaussians nor what matches."""
    threshold: float | None = None
    """Relevancy above which Gaussians match. Default: set by what stands out in the scene, at most 0.5."""
    min_alpha: float = 0.3
    """Coverage below which a pixel cannot match."""
    foreground: str = ""
    """Restrict matches in views without a mask to what this prompt finds, such as `building`. The view of a
    photo with a foreground mask is always restricted to that mask."""
    size: int | None = None
    """Longer side of pictures in pixels. Default: the photo's own, at most 1920."""
    views: int = 100
    """Number of training views, evenly spread, that `find` chooses from."""
    view_side: int = 256
    """Longer side in pixels of the views in which visible Gaussians are measured."""

    def __post_init__(self) -> None:
        """Raise UserError if an option is invalid."""
        check_numbers(self, _BOUNDS)


_BOUNDS = {
    "temperature": (1e-3, 1e4),
    "threshold": (0, 1),
    "min_alpha": (0, 1),
    "size": (1, 1 << 16),
    "views": (1, 1e6),
    "view_side": (8, 8192),
}
