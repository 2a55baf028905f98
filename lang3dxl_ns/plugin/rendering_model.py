"""Raster of Gaussians in a photo's look, with what they carry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.common.timing import part
from lang3dxl_ns.components.appearance import AppearanceField
from lang3dxl_ns.components.feature_decoder import SemanticEncoder
from lang3dxl_ns.components.sky import Sky
from lang3dxl_ns.plugin.answering import AnsweringModel
from lang3dxl_ns.plugin.cameras import to_rasterizer
from lang3dxl_ns.plugin.handover import SceneFacts
from lang3dxl_ns.plugin.model_config import Lang3DXLModelConfig
from lang3dxl_ns.rendering import Gaussians, Raster, rasterize, spherical_harmonics
from lang3dxl_ns.rendering.gaussians import MAX_LOG_SCALE
from lang3dxl_ns.rendering.rasterize import Backend
from lang3dxl_ns.scene.camera import Camera, in_view


class RenderingModel(AnsweringModel):
    """Gaussians with colors, and optionally with semantic values and looks."""

    config: Lang3DXLModelConfig
    semantic_field: SemanticEncoder | None
    appearance: AppearanceField | None
    sky: Sky | None
    """Of the first Gaussians; None: there is no sky, or it was trained like all Gaussians."""
    look: str | None
    """Photo whose look views are rendered with; None: the appearance's rule for unseen views."""
    fitted_look: Float[Tensor, " v"] | None = None
    """Vector to render with instead, during the half-image protocol."""

    @property
    def facts(self) -> SceneFacts:
        """What the data manager knows of the scene."""
        return SceneFacts.of(self.kwargs["metadata"])

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:  # type: ignore[override]
        """Render a camera: `rgb`, `accumulation`, `background`; in training `codes` [H, W, d] if the
        encoder learns from renderings; otherwise also `depth` and `bottleneck`, a picture of the codes."""
        keep = None
        self.carried_map = None
        if self.crop_box is not None and not self.training:
            keep = self.crop_box.within(self.means).squeeze(-1)
            if not keep.any():
                size = int(camera.width.item()), int(camera.height.item())
                return self.get_empty_outputs(*size, self.background_color.to(self.device))  # type: ignore[return-value]
        if self.training:
            return self._training_outputs(camera)
        asked = None if self.answers is None else self.answers.carried()
        colors = self._code_colors()
        carried = [part for part in (asked, colors) if part is not None]
        outputs, rendered = self.render(camera, torch.cat(carried, dim=1) if carried else None, keep)
        if self.semantic_field is not None:
            # Present from the first rendering on, since viewers list its outputs.
            outputs["bottleneck"] = outputs["background"]
        if rendered is not None and colors is not None:
            rendered, outputs["bottleneck"] = rendered.tensor_split([-3], dim=2)
        if asked is not None:
            self.carried_map = rendered
        return outputs

    def _training_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        carried = None
        if self.learns_from_renderings and self._warm_up_is_over:
            carried = self.carried
        outputs, codes = self.render(camera, carried)
        if self.means.requires_grad:
            self.strategy.step_pre_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step, self.info
            )
        if codes is not None:
            outputs["codes"] = codes
        return outputs

    @property
    def carried(self) -> Float[Tensor, "n d"] | None:
        """Semantic values that Gaussians carry; None if there are none (yet)."""
        return None if self.semantic_field is None else self.semantic_field.carried(self.gauss_params)

    @property
    def _warm_up_is_over(self) -> bool:
        return self.step >= self.config.warm_up * self.config.total_steps

    @property
    def learns_from_renderings(self) -> bool:
        """Whether semantics are trained with the scene, not gathered afterwards."""
        return self.semantic_field is not None and not self.semantic_field.needs_lifting

    def _code_colors(self) -> Float[Tensor, "n 3"] | None:
        if self.carried is None or (self.answers is not None and not self.answers.shows_bottleneck):
            return None
        assert self.semantic_field is not None
        return self.semantic_field.picture(self.carried.detach()).nan_to_num(0.0)

    def render(
        self, camera: Cameras, features: Float[Tensor, "n d"] | None = None, keep: Tensor | None = None
    ) -> tuple[dict[str, Tensor], Float[Tensor, "H W d"] | None]:
        """`rgb`, `accumulation`, `background`, and outside training `depth`, of a camera; and `features` of
        the Gaussians composited over black. keep: the Gaussians to render; default all."""
        with part("render"):
            rendering, background = self._render(camera, features, keep)
        self.info = rendering.info
        outputs = {
            "rgb": rendering.image.clamp(0.0, 1.0),
            "accumulation": rendering.alpha,
            "background": background if self.training else background.expand_as(rendering.image),
        }
        if rendering.depth is not None:
            far = rendering.depth.detach().max()
            outputs["depth"] = torch.where(rendering.alpha > 0, rendering.depth, far)
        return outputs, rendering.features

    def composite(self, camera: Cameras, features: Float[Tensor, "n d"]) -> Float[Tensor, "H W d"]:
        """Values of Gaussians composited over black in a camera; differentiable in the features alone."""
        view, _ = self._view(camera)
        gaussians = self.activated(self.gauss_params).detach()
        antialiased, backend = self.config.rasterize_mode == "antialiased", self.backend
        return rasterize(gaussians, view.detach(), features, antialiased=antialiased, backend=backend).image

    @property
    def backend(self) -> Backend:
        """The rasterizer asked for, which only a GPU has a choice of."""
        return self.config.rasterizer if self.means.is_cuda else "auto"

    def _view(self, camera: Cameras) -> tuple[Camera, Float[Tensor, "3 4"]]:
        """The camera for the rasterizer, refined in training, and its pose (on the model's device). The
        former stays on the CPU unless it is refined: there, reading its size takes no time."""
        pose = camera.camera_to_worlds[0]
        metadata = camera.metadata or {}
        if self.training and self.camera_optimizer.config.mode != "off" and "cam_idx" in metadata:
            index, pose = metadata["cam_idx"], to_device(pose, self.device)
            # A slice, since an index would be copied to the GPU first.
            change = self.camera_optimizer(slice(index, index + 1))[0]
            pose = torch.cat([change[:, :3] @ pose[:, :3], pose[:, 3:] + change[:, 3:]], dim=1)
        downscale = self._get_downscale_factor()
        if downscale != 1:
            camera.rescale_output_resolution(1 / downscale)
        view = to_rasterizer(camera, pose)
        if downscale != 1:
            camera.rescale_output_resolution(downscale)
        self.last_size = (view.height, view.width)
        return view, to_device(pose, self.device)

    def activated(self, g: Mapping[str, Tensor]) -> Gaussians:
        """Gaussians of the parameters `g`, which store log scales and logits of opacity."""
        scales = g["scales"].clamp_max(MAX_LOG_SCALE).exp()
        return Gaussians(g["means"], g["quats"], scales, g["opacities"].sigmoid().squeeze(-1))

    def _render(
        self, camera: Cameras, features: Tensor | None, keep: Tensor | None
    ) -> tuple[Raster, Float[Tensor, "3"]]:
        g = {name: p if keep is None else p[keep] for name, p in self.gauss_params.items()}
        if features is not None and keep is not None:
            features = features[keep]
        view, pose = self._view(camera)
        background = self._get_background_color()
        gaussians = self.activated(g)
        colors = self.colors_from(g, pose[:, 3])
        if self.sky is not None and self.training:
            gaussians, colors = self.sky(gaussians, colors)
        in_photo = gaussians
        if self.appearance is not None:
            vector = self._light(camera, pose)
            near = view.detach().to(self.device)
            visible = in_view(near, gaussians.means, gaussians.scales).nonzero().squeeze(1)
            seed = self.step if self.training else None
            with part("appearance"):
                colors, in_photo = self.appearance(gaussians, colors, vector, visible, seed)
        settings: dict[str, Any] = {
            "backend": self.backend,
            "antialiased": self.config.rasterize_mode == "antialiased",
            "absgrad": self.strategy.absgrad and self.training,
        }
        depth = not self.training or self.config.output_depth_during_training
        detach = not self.config.feature_gradient_to_geometry
        if in_photo is gaussians:
            rendering = rasterize(
                gaussians, view, colors, background,
                features=features, detach_features=detach, render_depth=depth, **settings,
            )  # fmt: skip
            return rendering, background
        photo = rasterize(in_photo, view, colors, background, **settings)
        if features is None and not depth:
            return photo, background
        # Semantics, coverage and depth belong to the scene, not to a photo: they keep its opacities.
        carried = colors.detach()[:, :1] if features is None else features
        if detach:
            gaussians, view = gaussians.detach(), view.detach()
        scene = rasterize(gaussians, view, carried, render_depth=depth, **settings | {"absgrad": False})
        image = None if features is None else scene.image
        return replace(photo, features=image, alpha=scene.alpha, depth=scene.depth), background

    def _light(self, camera: Cameras, pose: Float[Tensor, "3 4"]) -> Float[Tensor, " v"]:
        """Vector of the training photo, of the chosen look, or by the rule for other views."""
        assert self.appearance is not None
        position, direction = pose[:, 3].detach(), -pose[:, 2].detach()
        if self.training and camera.metadata and "cam_idx" in camera.metadata:
            name = self.facts.names[camera.metadata["cam_idx"]]
            self.appearance.remember(name, position, direction)
            return self.appearance.vector(name)
        if self.fitted_look is not None:
            return self.fitted_look
        if self.look is not None:
            return self.appearance.vector(self.look)
        return self.appearance.vector_of_view(position, direction)

    def colors_from(self, g: Mapping[str, Tensor], camera_center: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        """Colors seen from a point. The degree of the harmonics rises by one every 1,000 iterations, or
        every tenth of a run of under 10,000. At degree 0 colors are logits, as in splatfacto."""
        if self.config.sh_degree == 0:
            return torch.sigmoid(g["features_dc"])
        interval = max(min(self.config.sh_degree_interval, self.config.total_steps // 10), 1)
        degree = min(self.step // interval, self.config.sh_degree)
        directions = g["means"].detach() - camera_center
        coefficients = torch.cat((g["features_dc"][:, None], g["features_rest"]), dim=1)
        return (spherical_harmonics(degree, directions, coefficients) + 0.5).clamp_min(0.0)
