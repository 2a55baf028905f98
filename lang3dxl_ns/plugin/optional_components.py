"""Optional components of the model, with one interface: smooth sky, camera refinement, semantics, lighting.

The model is built, loaded and optimized through `COMPONENTS`. A component adds attributes to the model, after
which a checkpoint names its tensors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.baselines.decoders import make_decoder
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.timing import part
from lang3dxl_ns.components.appearance import AppearanceField
from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler
from lang3dxl_ns.components.sky import OPACITY, Sky
from lang3dxl_ns.plugin.model_config import ModelSettings
from lang3dxl_ns.plugin.rendering_model import RenderingModel
from lang3dxl_ns.preparation.handover import SceneFacts


class Component(ABC):
    """Interface of a part that a model may have."""

    attributes: tuple[str, ...]
    """Names of the model's attributes for this part, which `leave_out` sets to None unless overridden."""

    @abstractmethod
    def wanted(self, config: ModelSettings, facts: SceneFacts) -> bool:
        """Return whether a new model of this scene has the component."""

    @abstractmethod
    def build(self, model: RenderingModel) -> None:
        """Add the component, on the CPU, to a new model that has its Gaussians and strategy."""

    def leave_out(self, model: RenderingModel) -> None:
        """Mark the component as absent from the model."""
        for name in self.attributes:
            setattr(model, name, None)

    @abstractmethod
    def load(self, model: RenderingModel, state: Mapping[str, Any]) -> None:
        """Add, replace or leave out the component to match a checkpoint, which names tensors as the model
        does.

        Raises UserError if the model's settings contradict the checkpoint.
        """

    @abstractmethod
    def parameters(self, model: RenderingModel) -> dict[str, list[Parameter]]:
        """Return the component's optimizer groups by name; none if the model doesn't have it."""


class SmoothSky(Component):
    """The sky's colors as one smooth function, only where photos share one lighting: elsewhere it degrades
    words (docs/lab/short_and_long_runs.md). Without it the sky's Gaussians are trained like all others."""

    attributes = ("sky",)

    def wanted(self, config: ModelSettings, facts: SceneFacts) -> bool:
        return config.sky_gaussians > 0 and not Lighting().wanted(config, facts)

    def build(self, model: RenderingModel) -> None:
        count = model.config.sky_gaussians
        self._put(model, Sky(model.means.detach()[:count] - model.extent[0]))
        model.gauss_params["opacities"].data[:count] = torch.logit(torch.tensor(OPACITY))

    def leave_out(self, model: RenderingModel) -> None:
        super().leave_out(model)
        model.strategy.still = 0

    def load(self, model: RenderingModel, state: Mapping[str, Any]) -> None:
        saved = state.get("sky.directions")
        if saved is None:
            self.leave_out(model)
        elif model.sky is None or len(saved) != len(model.sky):
            self._put(model, Sky(torch.zeros_like(saved)).to(model.device))

    def parameters(self, model: RenderingModel) -> dict[str, list[Parameter]]:
        return {} if model.sky is None else {"sky": [model.sky.harmonics]}

    def _put(self, model: RenderingModel, sky: Sky) -> None:
        model.sky, model.strategy.still = sky, len(sky)


class CameraRefinement(Component):
    """Corrections of the training cameras. nerfstudio's viewer always requires a camera optimizer, so a model
    without refinement has one that is off."""

    attributes = ("camera_optimizer",)

    def wanted(self, config: ModelSettings, facts: SceneFacts) -> bool:
        choice = config.camera_optimization
        return facts.wants("camera optimizer", choice, False) or config.camera_optimizer.mode != "off"

    def build(self, model: RenderingModel) -> None:
        settings = model.config.camera_optimizer
        settings.mode = "SO3xR3" if settings.mode == "off" else settings.mode
        model.camera_optimizer = settings.setup(num_cameras=model.num_train_data, device="cpu")

    def leave_out(self, model: RenderingModel) -> None:
        off = CameraOptimizerConfig(mode="off")
        model.camera_optimizer = off.setup(num_cameras=model.num_train_data, device="cpu")

    def load(self, model: RenderingModel, state: Mapping[str, Any]) -> None:
        if "camera_optimizer.pose_adjustment" in state and model.config.camera_optimizer.mode == "off":
            self.build(model)
            model.camera_optimizer.to(model.device)

    def parameters(self, model: RenderingModel) -> dict[str, list[Parameter]]:
        groups: dict[str, list[Parameter]] = {}
        model.camera_optimizer.get_param_groups(groups)
        return groups


class Semantics(Component):
    """Codes of the Gaussians, the feature decoder, and the training-only downsampler; only with targets."""

    attributes = ("semantic_field", "downsampler")

    def wanted(self, config: ModelSettings, facts: SceneFacts) -> bool:
        return facts.statistics is not None

    def build(self, model: RenderingModel) -> None:
        statistics, targets = model.facts.statistics, model.facts.clip_targets
        assert statistics is not None and targets is not None
        clip, dense = statistics.clip, statistics.dense
        self._decode(model, clip.mean, clip.mean[:0] if dense is None else dense.mean)
        assert model.semantic_field is not None
        model.semantic_field.set_output_statistics(
            torch.cat([model.clip_mean, model.dense_mean]),
            clip.std if dense is None else torch.cat([clip.std, dense.std]),
        )
        with part("learn targets"):
            model.semantic_field.learn_targets(targets)
        self._carry(model)

    def load(self, model: RenderingModel, state: Mapping[str, Any]) -> None:
        if "clip_mean" not in state:
            return
        saved = {"CLIP": state["clip_mean"], "dense": state["dense_mean"]}
        if model.semantic_field is None:
            self._decode(model, *saved.values())
            self._carry(model)
        assert model.semantic_field is not None
        codes = state.get("gauss_params.codes")
        if isinstance(model.semantic_field, CompressedField) and codes is not None:
            model.semantic_field.fit_codes(codes)
        if model.semantic_field.needs_lifting and codes is not None:
            model.gauss_params["codes"] = Parameter(codes.clone(), requires_grad=False)
        model.to(model.device)
        prepared = {"CLIP": model.clip_mean, "dense": model.dense_mean}
        for kind, mean in saved.items():
            if len(mean) != len(prepared[kind]):
                raise UserError(
                    f"the checkpoint decodes to {kind} features of width {len(mean)}, but the prepared "
                    f"targets have {len(prepared[kind])}: pass the --pipeline.datamanager.{kind.lower()} "
                    "that the checkpoint was trained with, or train anew"
                )

    def parameters(self, model: RenderingModel) -> dict[str, list[Parameter]]:
        if model.semantic_field is None or model.downsampler is None:
            return {}
        groups = model.semantic_field.parameter_groups()
        if model.learns_from_renderings:
            groups["downsampler"] = list(model.downsampler.parameters())
        return groups

    def _decode(
        self, model: RenderingModel, clip_mean: Float[Tensor, " c"], dense_mean: Float[Tensor, " d"]
    ) -> None:
        """Build the feature decoder for features of this width."""
        model.register_buffer("clip_mean", clip_mean)
        model.register_buffer("dense_mean", dense_mean)
        c = model.config
        model.semantic_field = make_decoder(
            c.decoder, c.semantic_field, len(clip_mean), len(dense_mean), *model.extent
        )

    def _carry(self, model: RenderingModel) -> None:
        """Build the downsampler, and give every Gaussian a code."""
        assert model.semantic_field is not None
        model.downsampler = AttenuatedDownsampler(model.config.downsampler, len(model.clip_mean))
        codes = model.semantic_field.initial_codes(model.num_points)
        if codes is not None:
            model.gauss_params["codes"] = Parameter(codes)


class Lighting(Component):
    """Colors that depend on each photo's lighting."""

    attributes = ("appearance",)

    def wanted(self, config: ModelSettings, facts: SceneFacts) -> bool:
        return facts.wants("appearance", config.appearance.use)

    def build(self, model: RenderingModel) -> None:
        generator = torch.Generator().manual_seed(0)
        model.appearance = AppearanceField(
            model.config.appearance, model.facts.names, *model.extent, generator=generator
        )

    def load(self, model: RenderingModel, state: Mapping[str, Any]) -> None:
        """Match the checkpoint if the setting is `auto`; require that `on` and `off` agree with it."""
        saved = "appearance.vectors" in state
        if saved == (model.appearance is not None):
            return
        if model.config.appearance.use != "auto":
            raise UserError(
                f"the checkpoint was trained {'with' if saved else 'without'} appearance: load it with "
                f"--pipeline.model.appearance.use auto, or train anew"
            )
        self.leave_out(model)
        if saved:
            self.build(model)
            model.to(model.device)

    def parameters(self, model: RenderingModel) -> dict[str, list[Parameter]]:
        field = model.appearance
        if field is None:
            return {}
        return {"appearance_vectors": [field.vectors], "appearance": field.network_parameters()}


COMPONENTS: tuple[Component, ...] = (SmoothSky(), CameraRefinement(), Semantics(), Lighting())
"""Components in the order in which they are built, so that random numbers are the same in every version."""
