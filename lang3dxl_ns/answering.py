"""A model that adds to its renderings where they show what is asked for."""

from __future__ import annotations

import time
from collections.abc import Callable

from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.splatfacto import SplatfactoModel
from torch import Tensor

Answers = Callable[[dict[str, Tensor], Float[Tensor, "h w 3"], float], dict[str, Tensor]]
"""From a rendering's outputs, its codes, and the seconds that it took, to more outputs."""


class AnsweringModel(SplatfactoModel):
    """Viewers, `ns-render` and evaluations ask for a camera's outputs here, training doesn't."""

    answers: Answers | None = None
    """Whoever has something to ask hangs it in here."""
    rendered_codes: Float[Tensor, "h w 3"]
    """Of the latest rendering outside training."""

    def get_outputs_for_camera(  # type: ignore[override]
        self, camera: Cameras, obb_box: OrientedBox | None = None
    ) -> dict[str, Tensor]:
        """What the camera sees, and what is asked about it."""
        start = time.perf_counter()
        outputs = super().get_outputs_for_camera(camera, obb_box)
        if self.answers is not None and "bottleneck" in outputs:
            found = self.answers(outputs, self.rendered_codes, time.perf_counter() - start)
            # In the order in which viewers list them.
            outputs = {"rgb": outputs["rgb"], **found, "bottleneck": outputs["bottleneck"], **outputs}
        return outputs
