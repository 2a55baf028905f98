"""Rendering of Gaussians in training, and of the views that viewers and evaluations show."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.scene_box import OrientedBox
from torch import Tensor
from torch.optim import Optimizer

from lang3dxl_ns.common.console import say_once
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import part
from lang3dxl_ns.components.appearance import AppearanceField, render_in_look
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.sky import Sky
from lang3dxl_ns.plugin.cameras import photo_camera, to_rasterizer
from lang3dxl_ns.plugin.conversation import Conversation
from lang3dxl_ns.plugin.model_config import ModelSettings
from lang3dxl_ns.plugin.splatfacto import SplatfactoModel
from lang3dxl_ns.preparation.targets import SceneFacts
from lang3dxl_ns.query.question import QueryConfig, Question, pictures
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import EncodeTexts
from lang3dxl_ns.rendering import Rendering, Splats, composite
from lang3dxl_ns.rendering.rasterize import Backend
from lang3dxl_ns.scene.record import SceneRecord
from lang3dxl_ns.training.parts import CameraRefinement
from lang3dxl_ns.training.snapshot import snapshot
from lang3dxl_ns.training.state import Training
from lang3dxl_ns.training.step import render


@dataclass(frozen=True)
class RenderedAnswers:
    """The outputs that `ns-render` adds to every rendering, as a viewer's `Conversation` does."""

    question: Question
    shows_bottleneck: bool = True

    def channels(self) -> Tensor:
        """Return the values that Gaussians carry in a rendering."""
        return self.question.channels

    def outputs(self, rendering: Rendering, seconds: float) -> dict[str, Tensor]:
        """Return the outputs that answer the question."""
        return pictures(rendering, self.question)


class RenderingModel(SplatfactoModel):
    """Gaussians with colors, and optionally with semantic values and looks: a `Training` as a model of
    nerfstudio. Viewers, `ns-render` and evaluations render through `get_outputs_for_camera`, training through
    `get_outputs`."""

    config: ModelSettings
    run: Training
    """What is trained; its modules are also this model's, under the names of checkpoints."""
    camera_optimizer: CameraOptimizer
    semantic_field: Decoder | None
    downsampler: AttenuatedDownsampler | None
    appearance: AppearanceField | None
    sky: Sky | None
    clip_mean: Tensor
    dense_mean: Tensor
    answers: RenderedAnswers | Conversation | None = None
    refuses_lenses = False
    """Whether a camera that is not perspective is an error, as for `ns-render`; viewers are told of it."""

    def adopt_parts(self) -> None:
        """Register the parts of the run as this model's modules."""
        modules, semantics = self.run.parts.modules(), self.run.parts.semantics
        for name in ("sky", "semantic_field", "downsampler", "appearance"):
            setattr(self, name, modules.get(name))
        self.camera_optimizer = ViewersCameras(self.run.parts.cameras, self.num_train_data)
        if semantics is not None and not hasattr(self, "clip_mean"):
            self.register_buffer("clip_mean", semantics.clip_mean)
            self.register_buffer("dense_mean", semantics.dense_mean)

    @property
    def step(self) -> int:
        """The present iteration."""
        return self.run.step

    @step.setter
    def step(self, step: int) -> None:
        self.run.step = step

    @property  # type: ignore[override]
    def optimizers(self) -> Mapping[str, Optimizer]:
        """The optimizers, which nerfstudio sets before every iteration."""
        return self.run.optimizers

    @optimizers.setter
    def optimizers(self, optimizers: Mapping[str, Optimizer]) -> None:
        self.run.optimizers = optimizers

    @property
    def facts(self) -> SceneFacts:
        """Facts about the scene from the data manager."""
        return SceneFacts.of(self.kwargs["metadata"])

    @property
    def backend(self) -> Backend:
        """The requested rasterizer; only a GPU has a choice."""
        return self.run.backend

    @property
    def carried(self) -> Float[Tensor, "n d"] | None:
        """Semantic values that Gaussians carry; None if there are none (yet)."""
        return self.run.carried

    def splats(self) -> Splats:
        """Return the present Gaussians, which share memory with the model; `scene` takes copies."""
        return self.run.splats()

    # ── the scene so far ────────────────────────────────────────────────────────────────────────────

    @torch.no_grad()
    def scene(
        self,
        file: SceneRecord,
        *,
        config: QueryConfig | None = None,
        encode_texts: EncodeTexts | None = None,
        cache: Path | None = None,
        watch: Callable[[str], None] | None = None,
    ) -> Scene:
        """Copy the present state to a separate scene, which later training doesn't change, with the photos,
        cameras and CLIP of a file; for the other arguments see `Scene`. While a model has no words yet, its
        scene has colors only."""
        return snapshot(self.run, file, config=config, encode_texts=encode_texts, cache=cache, watch=watch)

    # ── looking ─────────────────────────────────────────────────────────────────────────────────────

    @torch.no_grad()
    def get_outputs_for_camera(  # type: ignore[override]
        self, camera: Cameras, obb_box: OrientedBox | None = None
    ) -> dict[str, Tensor]:
        """Return the camera's outputs in the order of viewers' lists, with the outputs of `answers` first."""
        if (kind := CameraType(int(camera.camera_type[0])).name.lower()) != "perspective":
            why = f"Gaussians are rendered in perspective, not as {kind}: choose the camera type perspective"
            if self.refuses_lenses:
                raise UserError(why)
            say_once(why)
        self.set_crop(obb_box)
        start, answers = time.perf_counter(), self.answers
        if answers is None:
            return self.get_outputs(camera)  # type: ignore[return-value]
        colors = self._code_colors() if answers.shows_bottleneck else None
        rendering, outputs = self._shown(camera, answers.channels(), colors)
        found = answers.outputs(rendering, time.perf_counter() - start)
        return {"rgb": outputs["rgb"], **found, **outputs}

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:  # type: ignore[override]
        """Render a camera: `rgb`, `accumulation`, `background`; in training also `codes` [H, W, d] if the
        decoder learns from renderings; otherwise also `depth` and `bottleneck`, a picture of the codes."""
        if self.training:
            return self._training_outputs(camera)
        return self._shown(camera, None, self._code_colors())[1]

    def seen(self, camera: Cameras, channels: Float[Tensor, "n d"] | None = None) -> Rendering:
        """Render the present Gaussians, and composite further `channels`, from a camera."""
        view, splats = to_rasterizer(camera, self._pose(camera)), self.splats()
        background = self._get_background_color()
        look = None if self.appearance is None else self.appearance.of_view(view)
        if self.crop_box is not None:
            keep = self.crop_box.within(splats.means).squeeze(-1)
            splats, channels = splats.select(keep), None if channels is None else channels[keep]
        return render_in_look(splats, view, look, channels, background=background, backend=self.backend)

    def _shown(
        self, camera: Cameras, asked: Float[Tensor, "n d"] | None, colors: Float[Tensor, "n 3"] | None
    ) -> tuple[Rendering, dict[str, Tensor]]:
        """Return a rendering with the channels `asked`, and the outputs of nerfstudio's viewer."""
        parts = [part for part in (asked, colors) if part is not None]
        rendering = self.seen(camera, channels=torch.cat(parts, dim=1) if parts else None)
        background, depth = self._get_background_color().expand_as(rendering.rgb), rendering.depth
        outputs = {
            "rgb": rendering.rgb,
            "accumulation": rendering.alpha[..., None],
            "background": background,
            "depth": torch.where(rendering.alpha > 0, depth, depth.max())[..., None],
        }
        if self.semantic_field is not None:
            # This output exists from the first rendering on, since viewers list that rendering's outputs.
            outputs["bottleneck"] = background
        if rendering.channels is not None and colors is not None:
            channels, outputs["bottleneck"] = rendering.channels.tensor_split([-3], dim=2)
            rendering = replace(rendering, channels=None if asked is None else channels)
        return rendering, outputs

    def composite(self, camera: Cameras, features: Float[Tensor, "n d"]) -> Float[Tensor, "H W d"]:
        """Composite values of Gaussians over black in a camera, refined like its training photo's;
        differentiable only in the values."""
        view = to_rasterizer(camera, self._pose(camera)).detach()
        return composite(self.splats(), view, features, self.backend)

    def _code_colors(self) -> Float[Tensor, "n 3"] | None:
        if self.carried is None:
            return None
        assert self.semantic_field is not None
        return self.semantic_field.picture(self.carried.detach()).nan_to_num(0.0)

    # ── training ────────────────────────────────────────────────────────────────────────────────────

    def _training_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        with part("render"):
            rendered = render(self.run, photo_camera(camera))
        outputs = {"rgb": rendered.rgb, "accumulation": rendered.alpha, "background": rendered.background}
        return outputs if rendered.codes is None else outputs | {"codes": rendered.codes}

    def _pose(self, camera: Cameras) -> Float[Tensor, "3 4"]:
        """Return camera → world, refined for a training photo. Without refinement the pose stays on the
        CPU."""
        return self.run.pose(photo_camera(camera))


class ViewersCameras(CameraOptimizer):
    """Refined cameras for nerfstudio's viewer, which always asks for a camera optimizer."""

    def __init__(self, cameras: CameraRefinement | None, count: int) -> None:
        super().__init__(CameraOptimizerConfig(mode="off"), num_cameras=count, device="cpu")
        self._refined = (cameras,)  # in a tuple: as a module, checkpoints would name its parameter otherwise
        if cameras is not None:
            self.pose_adjustment = cameras.pose_adjustment

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> ViewersCameras:
        """Convert the parameter, as when the model moves to a GPU, and keep it the run's own."""
        super()._apply(fn, recurse)
        if self._refined[0] is not None:
            self._refined[0].pose_adjustment = self.pose_adjustment
        return self

    def forward(self, indices: Tensor) -> Tensor:
        """Return the motions of some training cameras."""
        (cameras,) = self._refined
        return super().forward(indices) if cameras is None else cameras.motions(indices)
