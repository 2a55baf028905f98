"""Lang3D-XL as a model of nerfstudio: a `Training` in splatfacto's place, and the views that viewers show."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float, UInt8
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils.colors import get_color
from numpy import ndarray as Array
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.common.console import say_once
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing, without
from lang3dxl_ns.components.appearance import AppearanceField, render_in_look
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.evaluation.photo_metrics import ImageMetrics, psnr
from lang3dxl_ns.plugin.cameras import photo_camera
from lang3dxl_ns.plugin.inert_settings import OF_SPLATFACTO
from lang3dxl_ns.plugin.splatfacto import SplatfactoModel, SplatfactoModelConfig
from lang3dxl_ns.preparation.targets import FACTS, Batch, SceneFacts, foreground
from lang3dxl_ns.query.question import Question, pictures
from lang3dxl_ns.rendering import Rendering
from lang3dxl_ns.training.conversation import Conversation
from lang3dxl_ns.training.parts import CameraRefinement
from lang3dxl_ns.training.settings import TrainingSettings
from lang3dxl_ns.training.state import Training
from lang3dxl_ns.training.step import finish, losses, render


@without(*OF_SPLATFACTO)
@showing(
    *("decoder", "semantic_field", "appearance", "view_dependence", "camera_optimization", "sky_gaussians"),
    *("rasterizer", "max_gaussians", "sh_degree", "densify_from", "densify_until", "densify_every"),
    *("densify_grad_thresh", "ssim_lambda", "background_color", "clip_weight", "dense_weight"),
)
@dataclass
class Lang3DXLModelConfig(TrainingSettings, SplatfactoModelConfig):  # type: ignore[misc]
    """Settings of training, and of splatfacto where this package has none of its own."""

    _target: type = field(default_factory=lambda: Lang3DXLModel)
    num_downscales: int = 0
    """Always 0, since photos already vary in size."""


@dataclass(frozen=True)
class RenderedAnswers:
    """The outputs that `ns-render` adds to every rendering, as a viewer's `Conversation` does."""

    question: Question
    outlined: Callable[[Rendering], UInt8[Array, "h w 3"]] | None = None
    """Draws outlines of things; None unless a command asks for them, since finding them takes time."""
    shows_bottleneck: bool = True

    def channels(self) -> Tensor:
        """Return the values that Gaussians carry in a rendering."""
        return self.question.channels

    def outputs(self, rendering: Rendering, seconds: float) -> dict[str, Tensor]:
        """Return the outputs that answer the question, and the things' numbered outlines."""
        outputs = pictures(rendering, self.question)
        if self.outlined:
            outputs["things"] = torch.tensor(self.outlined(rendering) / 255.0).to(rendering.rgb)
        return outputs


class Lang3DXLModel(SplatfactoModel):
    """Gaussians with colors and semantic codes; without targets (clip = none) there are no semantic parts.
    Viewers, `ns-render` and evaluations render through `get_outputs_for_camera`, training through
    `get_outputs`."""

    config: Lang3DXLModelConfig
    run: Training
    """What is trained; its modules are also this model's, under the names of checkpoints."""
    camera_optimizer: CameraOptimizer
    semantic_field: Decoder | None
    appearance: AppearanceField | None
    answers: RenderedAnswers | Conversation | None = None
    step = 0
    """Splatfacto's counter, which only scales its photos, by 1 here; the iteration is `run.step`."""
    refuses_lenses = False
    """Whether a camera that is not perspective is an error, as for `ns-render`; viewers are told of it."""

    def populate_modules(self) -> None:
        """Build Gaussians, strategy, components and metrics (on the CPU; the pipeline moves them)."""
        self.config = self.config.fitted(self.config.total_steps)
        facts = self.kwargs["metadata"].get(FACTS) or SceneFacts()
        self.run = Training.begin(self.config, facts, self.seed_points)
        self.gauss_params = self.run.gaussians
        self.adopt_parts()
        self.image_metrics = ImageMetrics()
        self.crop_box = None
        self.background_color = get_color(
            "black" if self.config.background_color == "random" else self.config.background_color
        )

    def adopt_parts(self) -> None:
        """Register the parts of the run as this model's modules."""
        modules, semantics = self.run.parts.modules(), self.run.parts.semantics
        for name in ("sky", "semantic_field", "downsampler", "appearance"):
            setattr(self, name, modules.get(name))
        self.camera_optimizer = ViewersCameras(self.run.parts.cameras, self.num_train_data)
        if semantics is not None and not hasattr(self, "clip_mean"):
            self.register_buffer("clip_mean", semantics.clip_mean)
            self.register_buffer("dense_mean", semantics.dense_mean)

    def step_cb(self, optimizers: Optimizers, step: int) -> None:
        """Tell the run the iteration that begins, and its optimizers."""
        self.run.step, self.run.optimizers = step, optimizers.optimizers

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
        if not self.training:
            return self._shown(camera, None, self._code_colors())[1]
        rendered = render(self.run, photo_camera(camera))
        outputs = {"rgb": rendered.rgb, "accumulation": rendered.alpha, "background": rendered.background}
        return outputs if rendered.codes is None else outputs | {"codes": rendered.codes}

    def seen(self, camera: Cameras, channels: Float[Tensor, "n d"] | None = None) -> Rendering:
        """Render the present Gaussians, and composite further `channels`, from a camera."""
        photo, splats = photo_camera(camera), self.run.splats()
        view = photo.camera(self.run.pose(photo))
        background = self._get_background_color()
        look = None if self.appearance is None else self.appearance.of_view(view)
        if self.crop_box is not None:
            keep = self.crop_box.within(splats.means).squeeze(-1)
            splats, channels = splats.select(keep), None if channels is None else channels[keep]
        return render_in_look(splats, view, look, channels, background=background)

    def _shown(
        self, camera: Cameras, asked: Float[Tensor, "n d"] | None, colors: Float[Tensor, "n 3"] | None
    ) -> tuple[Rendering, dict[str, Tensor]]:
        """Return a rendering with the channels `asked`, and the outputs of nerfstudio's viewer."""
        named = {name: part for name, part in (("asked", asked), ("colors", colors)) if part is not None}
        rendering = self.seen(camera, torch.cat(list(named.values()), dim=1) if named else None)
        widths, values = [part.shape[1] for part in named.values()], rendering.channels
        maps = {} if values is None else dict(zip(named, values.split(widths, dim=2), strict=True))
        background, depth = self._get_background_color().expand_as(rendering.rgb), rendering.depth
        outputs = {
            "rgb": rendering.rgb,
            "accumulation": rendering.alpha[..., None],
            "background": background,
            "depth": torch.where(rendering.alpha > 0, depth, depth.max())[..., None],
        }
        if self.semantic_field is not None:
            # This output exists from the first rendering on, since viewers list that rendering's outputs.
            outputs["bottleneck"] = maps.get("colors", background)
        return replace(rendering, channels=maps.get("asked")), outputs

    def _code_colors(self) -> Float[Tensor, "n 3"] | None:
        if self.run.carried is None or self.semantic_field is None:
            return None
        return self.semantic_field.picture(self.run.carried.detach()).nan_to_num(0.0)

    # ── training ────────────────────────────────────────────────────────────────────────────────────

    def step_post_backward(self, step: int) -> None:
        """Finish an iteration."""
        finish(self.run)

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """Return the optimizer groups: one per Gaussian property, and those of the parts."""
        return self.run.groups()

    # ── losses and metrics ──────────────────────────────────────────────────────────────────────────

    def get_loss_dict(
        self, outputs: dict, batch: Batch, metrics_dict: dict | None = None
    ) -> dict[str, Tensor]:
        """Compute the color loss and, if there are semantics, the semantic losses, all already weighted."""
        return losses(self.run, outputs["rgb"], outputs.get("codes"), batch)

    def get_metrics_dict(self, outputs: dict, batch: Batch) -> dict[str, Tensor]:
        """Compute numbers for the log: PSNR of the step's photo, and the number of Gaussians."""
        found = psnr(outputs["rgb"].detach(), self.get_gt_img(batch["image"]))
        metrics = {"psnr": found, "gaussian_count": torch.tensor(self.num_points)}
        cameras = self.run.parts.cameras
        return metrics if cameras is None else metrics | cameras.figures()

    @torch.no_grad()
    def get_image_metrics_and_images(  # type: ignore[override]
        self, outputs: dict, batch: Batch
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Evaluate a held-out photo: PSNR, SSIM, and LPIPS if its weights are available."""
        target, predicted = self.get_gt_img(batch["image"]), outputs["rgb"]
        metrics = self.image_metrics(predicted, target, foreground(batch))
        images = {"img": torch.cat([target, predicted], dim=1)}
        if "bottleneck" in outputs:
            images["bottleneck"] = outputs["bottleneck"]
        return metrics, images

    # ── checkpoints ─────────────────────────────────────────────────────────────────────────────────

    def load_state_dict(self, state: Mapping[str, Any], **kwargs):  # type: ignore[override]
        """Load a checkpoint of any number of Gaussians, with or without semantics."""
        self.run.match(state)
        self.adopt_parts()
        self.run.step = self.config.total_steps
        return super(SplatfactoModel, self).load_state_dict(state, **kwargs)


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
