"""Training-free lifting: target features averaged onto the Gaussians by contribution."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.principal_basis import PrincipalBasis

_LEAST_COVERAGE = 1e-4


class LiftedFeatures(Decoder):
    """Decoder of features that are averaged onto the Gaussians after training, without compression.

    Gaussians carry nothing in training. Afterwards they carry the lifted features and a 1, whose rendering is
    the coverage. So a map is the mean feature of the visible Gaussians, however little of a pixel they cover.
    """

    needs_lifting = True

    def initial_codes(self, count: int, generator: torch.Generator | None = None) -> None:
        return None

    def carried(self, gaussians: Mapping[str, Tensor]) -> Float[Tensor, "n d"] | None:
        return gaussians.get("codes")

    def forward(
        self, rendered: Float[Tensor, "*batch d"]
    ) -> tuple[Float[Tensor, "*batch clip"], Float[Tensor, "*batch dense"] | None]:
        return self._split(rendered[..., :-1] / rendered[..., -1:].clamp_min(_LEAST_COVERAGE))

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {}

    def learn_gaussians(
        self,
        features: Float[Tensor, "n out"],
        mass: Float[Tensor, " n"],
        advance: Callable[[], None] = lambda: None,
        basis: PrincipalBasis | None = None,
    ) -> Float[Tensor, "n d"]:
        return torch.cat([features, (mass > 0).to(features)[:, None]], dim=1)
