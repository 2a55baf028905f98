"""Model base class with a hook that adds query outputs to renderings."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from torch import Tensor

from lang3dxl_ns.plugin.splatfacto import SplatfactoModel
from lang3dxl_ns.query.answer import Asked


class Answers(Protocol):
    """Hook called with each rendering outside training (viewer, ns-render)."""

    @property
    def shows_bottleneck(self) -> bool:
        """Whether anyone views the picture of the codes, which costs three more channels."""

    def carried(self) -> Float[Tensor, "n d"] | None:
        """Values that Gaussians carry in the next rendering; None without prompts."""

    def outputs(
        self, outputs: dict[str, Tensor], rendered: Float[Tensor, "h w d"] | None, seconds: float
    ) -> dict[str, Tensor]:
        """Additional outputs, from the rendering's outputs, the composited values, and its seconds."""


@dataclass
class RenderedAnswers:
    """The outputs that `ns-render` adds to every rendering."""

    asked: Asked
    shows_bottleneck: bool = True

    def carried(self) -> Tensor | None:
        return self.asked.carried

    def outputs(
        self, outputs: dict[str, Tensor], rendered: Tensor | None, seconds: float
    ) -> dict[str, Tensor]:
        return self.asked.outputs(outputs["rgb"], rendered, outputs["accumulation"][..., 0])


class AnsweringModel(SplatfactoModel):
    """Viewers, `ns-render` and evaluations render through `get_outputs_for_camera`, training doesn't."""

    answers: Answers | None = None
    carried_map: Float[Tensor, "h w d"] | None = None
    """Values composited for `answers` in the latest rendering."""
    _kept: _Kept | None = None

    def get_outputs_for_camera(  # type: ignore[override]
        self, camera: Cameras, obb_box: OrientedBox | None = None
    ) -> dict[str, Tensor]:
        """The camera's outputs, with those of `answers`."""
        start = time.perf_counter()
        if self.answers is None:
            return self._fresh(camera, obb_box)
        outputs = self._rendered(camera, obb_box)
        found = self.answers.outputs(outputs, self.carried_map, time.perf_counter() - start)
        # In the order in which viewers list them.
        return {"rgb": outputs["rgb"], **found, **outputs}

    @torch.no_grad()
    def _fresh(self, camera: Cameras, obb_box: OrientedBox | None) -> dict[str, Tensor]:
        """As splatfacto renders, but the camera stays where it is: its size is read without waiting for a
        GPU."""
        self.set_crop(obb_box)
        return self.get_outputs(camera)  # type: ignore[return-value]

    def _rendered(self, camera: Cameras, obb_box: OrientedBox | None) -> dict[str, Tensor]:
        """The rendering; reused if the same view gets another prompt or display."""
        assert self.answers is not None
        view = self._view_state(camera)
        asked, kept = self.answers.carried(), self._kept
        if kept is None or obb_box is not None or kept.view != view:
            outputs = self._fresh(camera, obb_box)
            self._kept = None if obb_box is not None else _Kept(view, outputs, asked, self.carried_map)
            return outputs
        if asked is not kept.asked:
            kept.asked, kept.carried_map = asked, None
            if asked is not None:
                kept.carried_map = self.composite(camera, asked)
        self.carried_map = kept.carried_map
        return kept.outputs

    def composite(self, camera: Cameras, features: Float[Tensor, "n d"]) -> Float[Tensor, "h w d"]:
        """Values that Gaussians carry, composited over black in a camera."""
        raise NotImplementedError

    def _view_state(self, camera: Cameras) -> tuple[Any, ...]:
        """Everything that a rendering depends on besides the prompts: camera, parameter versions, look."""
        assert self.answers is not None
        lens = camera.get_intrinsics_matrices().flatten().tolist()
        pose = camera.camera_to_worlds.flatten().tolist()
        size = int(camera.width.item()), int(camera.height.item())
        parameters = tuple((id(p), p._version) for p in self.parameters())
        shown = (self.answers.shows_bottleneck, getattr(self, "look", None))
        return (*pose, *lens, size, parameters, tuple(self.background_color.tolist()), *shown)


@dataclass
class _Kept:
    """The latest rendering of a view."""

    view: tuple[Any, ...]
    outputs: dict[str, Tensor]
    asked: Tensor | None
    carried_map: Tensor | None
