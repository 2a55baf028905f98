"""Optional components, attributes of the model: smooth sky, camera refinement, semantics, and lighting."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import part
from lang3dxl_ns.components.appearance import AppearanceField
from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.components.decoders import make_decoder
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler
from lang3dxl_ns.components.sky import OPACITY, Sky
from lang3dxl_ns.plugin.rendering_model import RenderingModel


def build_components(model: RenderingModel) -> None:
    """Add the components that the settings and the scene call for, on the CPU, to a new model that has its
    Gaussians and strategy."""
    config, facts = model.config, model.facts
    leave_out_components(model)
    lighting = facts.wants("appearance", config.appearance.use)
    if config.sky_gaussians > 0 and not lighting:
        build_sky(model)
    refined = facts.wants("camera optimizer", config.camera_optimization, False)
    if refined or config.camera_optimizer.mode != "off":
        build_camera_refinement(model)
    if facts.statistics is not None:
        build_semantics(model)
    if lighting:
        build_lighting(model)


def leave_out_components(model: RenderingModel) -> None:
    """Mark all components as absent. nerfstudio's viewer always requires a camera optimizer, so a model
    without refinement has one that is off."""
    model.sky = model.semantic_field = model.downsampler = model.appearance = None
    model.strategy.still = 0
    off = CameraOptimizerConfig(mode="off")
    model.camera_optimizer = off.setup(num_cameras=model.num_train_data, device="cpu")


def component_parameters(model: RenderingModel) -> dict[str, list[Parameter]]:
    """Return the optimizer groups of the components that the model has, by name."""
    groups = {} if model.sky is None else {"sky": [model.sky.harmonics]}
    model.camera_optimizer.get_param_groups(groups)
    if model.semantic_field is not None and model.downsampler is not None:
        groups |= model.semantic_field.parameter_groups()
        if model.learns_from_renderings:
            groups["downsampler"] = list(model.downsampler.parameters())
    if model.appearance is not None:
        groups["appearance_vectors"] = [model.appearance.vectors]
        groups["appearance"] = model.appearance.network_parameters()
    return groups


def match_components(model: RenderingModel, state: Mapping[str, Any]) -> None:
    """Add, replace or leave out components to match a checkpoint, which names tensors as the model does.
    Raises UserError if the model's settings contradict the checkpoint."""
    directions = state.get("sky.directions")
    if directions is None:
        model.sky = None
    elif model.sky is None:
        model.sky = Sky(torch.zeros_like(directions)).to(model.device)
    else:  # the optimizer holds its colors
        model.sky.directions = directions.to(model.device)
    model.strategy.still = 0 if model.sky is None else len(model.sky)
    if "camera_optimizer.pose_adjustment" in state and model.config.camera_optimizer.mode == "off":
        build_camera_refinement(model)
        model.camera_optimizer.to(model.device)
    if "clip_mean" in state:
        _match_semantics(model, state)
    lit = "appearance.vectors" in state
    if lit != (model.appearance is not None):
        if model.config.appearance.use != "auto":
            raise UserError(
                f"the checkpoint was trained {'with' if lit else 'without'} appearance: load it with "
                f"--pipeline.model.appearance.use auto, or train anew"
            )
        model.appearance = None
        if lit:
            build_lighting(model)
            model.to(model.device)


def build_sky(model: RenderingModel) -> None:
    """Add the sky's colors as one smooth function, only where photos share one lighting: elsewhere it
    degrades words (docs/lab/short_and_long_runs.md)."""
    count = model.config.sky_gaussians
    model.sky, model.strategy.still = Sky(model.means.detach()[:count] - model.extent[0]), count
    model.gauss_params["opacities"].data[:count] = torch.logit(torch.tensor(OPACITY))


def build_camera_refinement(model: RenderingModel) -> None:
    """Add corrections of the training cameras."""
    settings = model.config.camera_optimizer
    settings.mode = "SO3xR3" if settings.mode == "off" else settings.mode
    model.camera_optimizer = settings.setup(num_cameras=model.num_train_data, device="cpu")


def build_lighting(model: RenderingModel) -> None:
    """Add colors that depend on each photo's lighting."""
    generator, names = torch.Generator().manual_seed(0), model.facts.names
    model.appearance = AppearanceField(model.config.appearance, names, *model.extent, generator=generator)


def build_semantics(model: RenderingModel) -> None:
    """Add codes of the Gaussians, the feature decoder, and the training-only downsampler."""
    statistics, targets = model.facts.statistics, model.facts.clip_targets
    assert statistics is not None and targets is not None
    clip, dense = statistics.clip, statistics.dense
    _add_decoder(model, clip.mean, clip.mean[:0] if dense is None else dense.mean)
    assert model.semantic_field is not None
    model.semantic_field.set_output_statistics(
        torch.cat([model.clip_mean, model.dense_mean]),
        clip.std if dense is None else torch.cat([clip.std, dense.std]),
    )
    with part("learn targets"):
        model.semantic_field.learn_targets(targets)
    _add_codes(model)


def _match_semantics(model: RenderingModel, state: Mapping[str, Any]) -> None:
    saved = {"CLIP": state["clip_mean"], "dense": state["dense_mean"]}
    if model.semantic_field is None:
        _add_decoder(model, *saved.values())
        _add_codes(model)
    assert model.semantic_field is not None
    codes = state.get("gauss_params.codes")
    if isinstance(model.semantic_field, CompressedField) and codes is not None:
        model.semantic_field.fit_codes(codes)
    if model.semantic_field.needs_lifting and codes is not None:
        model.gauss_params["codes"] = Parameter(codes.clone(), requires_grad=False)
    model.to(model.device)
    for kind, mean in {"CLIP": model.clip_mean, "dense": model.dense_mean}.items():
        if len(saved[kind]) != len(mean):
            raise UserError(
                f"the checkpoint decodes to {kind} features of width {len(saved[kind])}, but the prepared "
                f"targets have {len(mean)}: pass the --pipeline.datamanager.{kind.lower()} "
                "that the checkpoint was trained with, or train anew"
            )


def _add_decoder(model: RenderingModel, clip_mean: Tensor, dense_mean: Tensor) -> None:
    model.register_buffer("clip_mean", clip_mean)
    model.register_buffer("dense_mean", dense_mean)
    c, channels = model.config, (len(clip_mean), len(dense_mean))
    model.semantic_field = make_decoder(c.decoder, c.semantic_field, *channels)
    model.semantic_field.set_extent(*model.extent)


def _add_codes(model: RenderingModel) -> None:
    """Add the downsampler, and give every Gaussian a code."""
    assert model.semantic_field is not None
    model.downsampler = AttenuatedDownsampler(model.config.downsampler, len(model.clip_mean))
    codes = model.semantic_field.initial_codes(model.num_points)
    if codes is not None:
        model.gauss_params["codes"] = Parameter(codes)
