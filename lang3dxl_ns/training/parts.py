"""Optional parts of a scene in training: smooth sky, refined cameras, semantics, and looks of photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import Parameter

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import data_option, model_option
from lang3dxl_ns.components.appearance import AppearanceField
from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.components.decoders import make_decoder
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.sky import OPACITY, Sky
from lang3dxl_ns.preparation.targets import SceneFacts
from lang3dxl_ns.training.gaussians import Parameters
from lang3dxl_ns.training.settings import TrainingSettings

Extent = tuple[Float[Tensor, "3"], float]
"""Center of the scene, and the distance from it that contains most of the scene, world units."""
_SHIFT_WEIGHT, _TURN_WEIGHT = 1e-2, 1e-3
"""Weights of the mean length of the cameras' translations, world units, and of their mean angle, radians."""


class CameraRefinement(nn.Module):
    """A small motion of every training camera, 0 at first: a translation (world units), and a rotation vector
    (radians) about the camera's center."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.pose_adjustment = Parameter(torch.zeros(count, 6))

    def forward(self, poses: Float[Tensor, "k 3 4"], photos: slice) -> Float[Tensor, "k 3 4"]:
        """Apply the motions of some training photos to their poses (camera → world)."""
        change, poses = self.motions(photos), to_device(poses, self.pose_adjustment.device)
        return torch.cat([change[..., :3] @ poses[..., :3], poses[..., 3:] + change[..., 3:]], dim=2)

    def motions(self, photos: slice | Tensor) -> Float[Tensor, "k 3 4"]:
        """Compute the motions of some training photos as rotation and translation, by Rodrigues' formula."""
        motion = self.pose_adjustment[photos]
        translation, vector = motion[:, :3], motion[:, 3:]
        # Below a hundredth the angle is held, since its gradient at 0 is not finite.
        angle = (vector * vector).sum(1).clamp(1e-4).sqrt()[:, None, None]
        inverse = 1.0 / angle
        x, y, z = vector.unbind(1)
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).view(-1, 3, 3)
        turned = inverse * angle.sin() * cross + inverse * inverse * (1.0 - angle.cos()) * (cross @ cross)
        rotation = turned + torch.eye(3, dtype=vector.dtype, device=vector.device)
        return torch.cat([rotation, translation[..., None]], dim=2)

    def penalty(self) -> Float[Tensor, ""]:
        """Compute the loss that keeps cameras near their places."""
        shifts, turns = self.pose_adjustment.split(3, dim=1)
        return _SHIFT_WEIGHT * shifts.norm(dim=-1).mean() + _TURN_WEIGHT * turns.norm(dim=-1).mean()

    def figures(self) -> dict[str, Tensor]:
        """Return mean and maximum of the translations and of the rotations (degrees), for the log."""
        change, figures = self.pose_adjustment.detach(), dict[str, Tensor]()
        for name, sizes in {"translation": change[:, :3], "rotation": change[:, 3:].rad2deg()}.items():
            figures[f"camera_opt_{name}_mean"] = sizes.norm(dim=1).mean()
            figures[f"camera_opt_{name}_max"] = sizes.norm(dim=1).max()
        return figures


@dataclass(frozen=True, eq=False)
class Semantics:
    """What decodes the Gaussians' codes, and the mean training features."""

    decoder: Decoder
    downsampler: AttenuatedDownsampler
    """Reduces decoded features to the grid of the CLIP targets, in training only."""
    clip_mean: Float[Tensor, " c"]
    dense_mean: Float[Tensor, " d"]


@dataclass(frozen=True, eq=False)
class Parts:
    """Optional parts; None: the scene does without."""

    sky: Sky | None = None
    """Colors of the sky's Gaussians, the first ones. Without it they train like the rest."""
    cameras: CameraRefinement | None = None
    semantics: Semantics | None = None
    appearance: AppearanceField | None = None

    @staticmethod
    def build(settings: TrainingSettings, facts: SceneFacts, gaussians: Parameters, extent: Extent) -> Parts:
        """Build the parts that the settings and the scene call for, on the CPU. New Gaussians get what these
        parts need, in place: the sky's opacity, and codes."""
        lighting = facts.wants("appearance", settings.appearance.use)
        refined = facts.wants("camera optimizer", settings.camera_optimization, False)
        return Parts(
            build_sky(settings, gaussians, extent) if settings.sky_gaussians > 0 and not lighting else None,
            CameraRefinement(len(facts.names)) if refined else None,
            None if facts.statistics is None else build_semantics(settings, facts, gaussians, extent),
            build_looks(settings, facts, extent) if lighting else None,
        )

    def modules(self) -> dict[str, nn.Module]:
        """Return the modules of the parts that are there, named as in checkpoints."""
        semantics = self.semantics
        named: dict[str, nn.Module | None] = {
            "sky": self.sky,
            "camera_optimizer": self.cameras,
            "semantic_field": None if semantics is None else semantics.decoder,
            "downsampler": None if semantics is None else semantics.downsampler,
            "appearance": self.appearance,
        }
        return {name: module for name, module in named.items() if module is not None}

    def groups(self) -> dict[str, list[Parameter]]:
        """Return the parameters to optimize, by group."""
        groups = {} if self.sky is None else {"sky": [self.sky.harmonics]}
        if self.cameras is not None:
            groups["camera_opt"] = [self.cameras.pose_adjustment]
        if self.semantics is not None:
            groups |= self.semantics.decoder.parameter_groups()
            if not self.semantics.decoder.needs_lifting:
                groups["downsampler"] = list(self.semantics.downsampler.parameters())
        if self.appearance is not None:
            vectors = self.appearance.vectors
            groups["appearance_vectors"] = [vectors]
            groups["appearance"] = [
                shared for shared in self.appearance.parameters() if shared is not vectors
            ]
        return groups

    def matching(
        self,
        state: Mapping[str, Any],
        settings: TrainingSettings,
        facts: SceneFacts,
        gaussians: Parameters,
        extent: Extent,
    ) -> Parts:
        """Return parts like those of a checkpoint: these, with some added, replaced or left out, and ready
        for its tensors. `state` has those of the whole scene by name. Raises UserError if the settings
        contradict the checkpoint."""
        device = gaussians["means"].device
        found = replace(self, sky=_matching_sky(self.sky, state, device))
        if "camera_optimizer.pose_adjustment" in state and self.cameras is None:
            found = replace(found, cameras=CameraRefinement(len(facts.names)).to(device))
        if "clip_mean" in state:
            semantics = _matching_semantics(self.semantics, state, settings, gaussians, extent)
            found = replace(found, semantics=semantics)
        lit = "appearance.vectors" in state
        if lit != (self.appearance is not None):
            if settings.appearance.use != "auto":
                raise UserError(
                    f"the checkpoint was trained {'with' if lit else 'without'} appearance: load it with "
                    f"{model_option('appearance.use')} auto, or train anew"
                )
            looks = build_looks(settings, facts, extent).to(device) if lit else None
            found = replace(found, appearance=looks)
        return found


def build_sky(settings: TrainingSettings, gaussians: Parameters, extent: Extent) -> Sky:
    """Build the sky's colors as one smooth function, only where photos share one lighting: elsewhere it
    degrades words (docs/lab/short_and_long_runs.md)."""
    count = settings.sky_gaussians
    gaussians["opacities"].data[:count] = torch.logit(torch.tensor(OPACITY))
    return Sky(gaussians["means"].detach()[:count] - extent[0])


def build_looks(settings: TrainingSettings, facts: SceneFacts, extent: Extent) -> AppearanceField:
    """Build colors that depend on each photo's lighting."""
    generator = torch.Generator().manual_seed(0)
    return AppearanceField(settings.appearance, facts.names, *extent, generator=generator)


def build_semantics(
    settings: TrainingSettings, facts: SceneFacts, gaussians: Parameters, extent: Extent
) -> Semantics:
    """Build the feature decoder and the training-only downsampler, and give every Gaussian a code."""
    statistics, targets = facts.statistics, facts.clip_targets
    assert statistics is not None and targets is not None
    clip, dense = statistics.clip, statistics.dense
    dense_mean = clip.mean[:0] if dense is None else dense.mean
    decoder = _decoder(settings, extent, len(clip.mean), len(dense_mean))
    decoder.set_output_statistics(
        torch.cat([clip.mean, dense_mean]), clip.std if dense is None else torch.cat([clip.std, dense.std])
    )
    decoder.learn_targets(targets)
    return _with_codes(decoder, clip.mean, dense_mean, settings, gaussians)


def _decoder(settings: TrainingSettings, extent: Extent, clip: int, dense: int) -> Decoder:
    decoder = make_decoder(settings.decoder, settings.semantic_field, clip, dense)
    decoder.set_extent(*extent)
    return decoder


def _with_codes(
    decoder: Decoder, clip: Tensor, dense: Tensor, settings: TrainingSettings, gaussians: Parameters
) -> Semantics:
    """Add the downsampler, and give every Gaussian a code."""
    downsampler = AttenuatedDownsampler(settings.downsampler, len(clip))
    codes = decoder.initial_codes(len(gaussians["means"]))
    if codes is not None:
        gaussians["codes"] = Parameter(codes.to(gaussians["means"].device))
    return Semantics(decoder, downsampler, clip, dense)


def _matching_sky(sky: Sky | None, state: Mapping[str, Any], device: torch.device) -> Sky | None:
    directions = state.get("sky.directions")
    if directions is None:
        return None
    if sky is None:
        return Sky(torch.zeros_like(directions)).to(device)
    sky.directions = directions.to(device)  # the optimizer holds its colors
    return sky


def _matching_semantics(
    mine: Semantics | None,
    state: Mapping[str, Any],
    settings: TrainingSettings,
    gaussians: Parameters,
    extent: Extent,
) -> Semantics:
    clip, dense, codes = state["clip_mean"], state["dense_mean"], state.get("gauss_params.codes")
    device = gaussians["means"].device
    if mine is None:
        decoder = _decoder(settings, extent, len(clip), len(dense)).to(device)
        means = clip.clone().to(device), dense.clone().to(device)
        mine = _with_codes(decoder, *means, settings, gaussians)
        mine.downsampler.to(device)
    if isinstance(mine.decoder, CompressedField) and codes is not None:
        mine.decoder.fit_codes(codes)
        mine.decoder.to(device)
    if mine.decoder.needs_lifting and codes is not None:
        gaussians["codes"] = Parameter(codes.clone().to(device), requires_grad=False)
    for kind, there, here in (("CLIP", clip, mine.clip_mean), ("dense", dense, mine.dense_mean)):
        if len(there) != len(here):
            raise UserError(
                f"the checkpoint decodes to {kind} features of width {len(there)}, but the prepared "
                f"targets have {len(here)}: pass the {data_option(kind.lower())} "
                "that the checkpoint was trained with, or train anew"
            )
    return mine
