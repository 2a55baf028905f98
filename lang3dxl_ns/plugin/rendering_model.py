"""Rendering of Gaussians in training, and of the views that viewers and evaluations show."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.scene_box import OrientedBox
from torch import Tensor

from lang3dxl_ns.common.console import say_once
from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.image import fitted_size
from lang3dxl_ns.common.reports import part
from lang3dxl_ns.components.appearance import AppearanceField, render_in_look
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.sky import Sky
from lang3dxl_ns.plugin.cameras import to_rasterizer
from lang3dxl_ns.plugin.conversation import Conversation
from lang3dxl_ns.plugin.densification import Densification
from lang3dxl_ns.plugin.model_config import ModelSettings
from lang3dxl_ns.plugin.splatfacto import SplatfactoModel
from lang3dxl_ns.preparation.targets import SceneFacts
from lang3dxl_ns.query.question import QueryConfig, Question, pictures
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import EncodeTexts
from lang3dxl_ns.rendering import Gaussians, Raster, Rendering, Splats, composite, rasterize
from lang3dxl_ns.rendering.gaussians import MAX_LOG_SCALE
from lang3dxl_ns.rendering.rasterize import Backend, at_fewer_pixels
from lang3dxl_ns.rendering.spherical_harmonics import spherical_harmonics
from lang3dxl_ns.rendering.splats import harmonics_of
from lang3dxl_ns.scene.camera import in_view
from lang3dxl_ns.scene.record import SceneRecord

DECODE_SIZES = 5
"""Number of sizes at which what Gaussians carry is drawn and decoded in training."""


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
    """Gaussians with colors, and optionally with semantic values and looks. Viewers, `ns-render` and
    evaluations render through `get_outputs_for_camera`, training through `get_outputs`."""

    config: ModelSettings
    strategy: Densification
    extent: tuple[Float[Tensor, "3"], float]
    """Center of the scene, and the distance from it that contains most of the scene."""
    semantic_field: Decoder | None
    downsampler: AttenuatedDownsampler | None
    clip_mean: Tensor
    dense_mean: Tensor
    appearance: AppearanceField | None
    sky: Sky | None
    """Colors of the sky's Gaussians, the first ones; None: there is none, or it trained like the rest."""
    answers: RenderedAnswers | Conversation | None = None
    codes_have_begun = False
    """Whether training has reached the codes; part of a checkpoint's run state."""
    refuses_lenses = False
    """Whether a camera that is not perspective is an error, as for `ns-render`; viewers are told of it."""

    @property
    def facts(self) -> SceneFacts:
        """Facts about the scene from the data manager."""
        return SceneFacts.of(self.kwargs["metadata"])

    @property
    def backend(self) -> Backend:
        """The requested rasterizer; only a GPU has a choice."""
        return self.config.rasterizer if self.means.is_cuda else "auto"

    @property
    def carried(self) -> Float[Tensor, "n d"] | None:
        """Semantic values that Gaussians carry; None if there are none (yet)."""
        return None if self.semantic_field is None else self.semantic_field.carried(self.gauss_params)

    @property
    def learns_from_renderings(self) -> bool:
        """Whether semantics are trained with the scene instead of being gathered afterwards."""
        return self.semantic_field is not None and not self.semantic_field.needs_lifting

    # ── the scene so far ────────────────────────────────────────────────────────────────────────────

    @torch.no_grad()
    def splats(self) -> Splats:
        """Return the present Gaussians, which share memory with the model; `scene` takes copies."""
        g = {name: parameter.detach() for name, parameter in self.gauss_params.items()}
        if self.config.sh_degree > 0:
            harmonics = _coefficients(g)[:, : (self.degree + 1) ** 2]
        else:
            harmonics = harmonics_of(torch.sigmoid(g["features_dc"]))
        antialiased = self.config.rasterize_mode == "antialiased"
        return Splats(**vars(self.activated(g)), harmonics=harmonics, antialiased=antialiased)

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
        codes, looks = self.carried, self.appearance
        return Scene(
            self.splats().mapped(torch.clone),
            file,
            None if codes is None else _frozen(self.semantic_field),
            None if codes is None else codes.detach().clone(),
            looks=None if looks is None else _frozen(looks),
            background=self._get_background_color().clone(),
            config=config or QueryConfig(),
            encode_texts=encode_texts,
            cache=cache,
            backend=self.backend,
            watch=watch,
        )

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
        carried = self.carried if self.learns_from_renderings and self._warm_up_is_over else None
        with part("render"):
            raster, background, codes = self._raster(camera, carried)
        if self.means.requires_grad:
            self.strategy.step_pre_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step, raster.info
            )
        outputs = {
            "rgb": raster.image.clamp(0.0, 1.0),
            "accumulation": raster.alpha,
            "background": background,
        }
        return outputs if codes is None else outputs | {"codes": codes}

    @property
    def _warm_up_is_over(self) -> bool:
        return self.step >= self.config.warm_up * self.config.total_steps

    @property
    def codes_begin(self) -> bool:
        """Whether codes are about to be trained for the first time. This is so once per run, also if the run
        is resumed or prolonged."""
        return self.learns_from_renderings and self._warm_up_is_over and not self.codes_have_begun

    def _pose(self, camera: Cameras) -> Float[Tensor, "3 4"]:
        """Return camera → world, refined for a training photo. Without refinement the pose stays on the
        CPU."""
        poses, metadata = camera.camera_to_worlds, camera.metadata or {}
        if "cam_idx" in metadata:
            # A slice is used, since an index would be copied to the GPU first.
            poses = self.refined(poses, slice(metadata["cam_idx"], metadata["cam_idx"] + 1))
        return poses[0]

    def refined(self, poses: Float[Tensor, "k 3 4"], photos: slice) -> Float[Tensor, "k 3 4"]:
        """Apply training's corrections to the poses (camera → world) of some training photos."""
        if self.camera_optimizer.config.mode == "off":
            return poses
        poses, change = to_device(poses, self.device), self.camera_optimizer(photos)
        return torch.cat([change[..., :3] @ poses[..., :3], poses[..., 3:] + change[..., 3:]], dim=2)

    def activated(self, g: Mapping[str, Tensor]) -> Gaussians:
        """Activate the parameters `g`, which store log scales and logits of opacity, to Gaussians."""
        scales = g["scales"].clamp_max(MAX_LOG_SCALE).exp()
        return Gaussians(g["means"], g["quats"], scales, g["opacities"].sigmoid().squeeze(-1))

    def _raster(
        self, camera: Cameras, carried: Tensor | None
    ) -> tuple[Raster, Float[Tensor, "3"], Float[Tensor, "h w d"] | None]:
        """Render a training step, with gradients: the photo, its background, and what Gaussians carry, at the
        size that the step decodes."""
        g, pose = self.gauss_params, self._pose(camera)
        view, pose = to_rasterizer(camera, pose), to_device(pose, self.device)
        background = self._get_background_color()
        gaussians = self.activated(g)
        colors = self.colors_from(g, pose[:, 3])
        if self.sky is not None:
            gaussians, colors = self.sky(gaussians, colors)
        in_photo = gaussians
        if self.appearance is not None:
            vector = self._vector(camera, pose)
            near = view.detach().to(self.device)
            visible = in_view(near, gaussians.means, gaussians.scales).nonzero().squeeze(1)
            with part("appearance"):
                colors, in_photo = self.appearance(gaussians, colors, vector, visible, self.step)
        antialiased = self.config.rasterize_mode == "antialiased"
        settings: dict[str, Any] = {"backend": self.backend, "antialiased": antialiased}
        photo = rasterize(in_photo.seen_from(view), view, colors, background, **settings)
        if carried is None:
            return photo, background, None
        # Semantics belong to the scene, not to a photo, so they keep the scene's opacities.
        if self.config.feature_gradient_to_geometry:
            gaussians = replace(gaussians, opacities=gaussians.opacities.detach())
        else:
            gaussians, view = gaussians.detach(), view.detach()
        # A photo has many times the pixels that are decoded. The same ellipses are drawn at these alone.
        small, eps2d = at_fewer_pixels(view, *fitted_size((view.height, view.width), self.decoded_side))
        codes = rasterize(gaussians.seen_from(view), small, carried, eps2d=eps2d, **settings).image
        return photo, background, codes

    @property
    def decoded_side(self) -> int:
        """The longer side at which this iteration decodes: one of a few, since a GPU's libraries prepare for
        every new size, and the same after a resume."""
        assert self.config.decode_size is not None
        smallest, largest = self.config.decode_size
        generator = torch.Generator().manual_seed(self.step)
        place = int(torch.randint(DECODE_SIZES, (), generator=generator)) / (DECODE_SIZES - 1)
        return round(smallest + place * (largest - smallest))

    def _vector(self, camera: Cameras, pose: Float[Tensor, "3 4"]) -> Float[Tensor, " v"]:
        """Return the training photo's appearance vector, or for other views the one that the rule chooses."""
        assert self.appearance is not None
        position, direction = pose[:, 3].detach(), -pose[:, 2].detach()
        if camera.metadata and "cam_idx" in camera.metadata:
            name = self.facts.names[camera.metadata["cam_idx"]]
            self.appearance.remember(name, position, direction)
            return self.appearance.vector(name)
        return self.appearance.vector_of_view(position, direction)

    @property
    def degree(self) -> int:
        """Degree of the harmonics in use: it rises by one every 1,000 iterations, or every tenth of a run of
        under 10,000."""
        interval = max(min(self.config.sh_degree_interval, self.config.total_steps // 10), 1)
        return min(self.step // interval, self.config.sh_degree)

    def colors_from(self, g: Mapping[str, Tensor], camera_center: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        """Compute the colors seen from a point. At degree 0 colors are stored as logits, as in splatfacto."""
        if self.config.sh_degree == 0:
            return torch.sigmoid(g["features_dc"])
        directions = g["means"].detach() - camera_center
        return (spherical_harmonics(self.degree, directions, _coefficients(g)) + 0.5).clamp_min(0.0)


def _coefficients(g: Mapping[str, Tensor]) -> Float[Tensor, "n k 3"]:
    return torch.cat((g["features_dc"][:, None], g["features_rest"]), dim=1)


def _frozen(module: Any) -> Any:
    """Copy a module without gradients, for evaluation."""
    return deepcopy(module).eval().requires_grad_(False)
