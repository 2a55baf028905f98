"""Appearance field: a network that takes a Gaussian's position and base color and a photo's vector, and
predicts the Gaussian's color shift in that photo (SWAG, Dahmani et al. 2024, as used in Lang3D-XL).

Only colors, and optionally opacities, depend on the photo; semantics never do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lang3dxl_ns.common.console import some
from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.components.hash_grid import HashGrid
from lang3dxl_ns.components.linear import linear
from lang3dxl_ns.rendering import Gaussians, Rendering, Splats, harmonics_of, render
from lang3dxl_ns.scene.camera import Camera, in_view

HIDDEN = 64
TEMPERATURE = 0.1
"""Temperature of the Binary Concrete distribution from which opacity shifts are sampled."""
FIRST_DEVIATION = 0.1
"""Standard deviation of the initial vectors. The published 1 separates photos too much: on eleven photos that
differ in exposure and white balance, the error after 300 steps is twice that with 0.1."""
FIRST_LOGIT = -4.0
"""Log odds that an untrained opacity shift removes a Gaussian from a training step: about 2 %."""
# Lighting changes smoothly over a building, from wall to wall. Finer grids take longer, and learn a photo's
# patches instead of its lighting.
GRIDS = {"coarse": (2, 4, 14, 6, 12), "paper": (12, 2, 19, 16, 2048)}
"""`HashGrid` settings by preset: levels, features per level, log2 of the table's size, and lowest and highest
resolution."""


@showing("use", "preset")
@dataclass
class AppearanceConfig:
    """Settings of the appearance field."""

    use: Literal["auto", "on", "off"] = "auto"
    """Whether to model the lighting of each photo. `auto`: on, unless the scene's measured needs show that
    its photos share one lighting. If off, the component is not built and has no parameters or cost."""
    preset: Literal["auto", "coarse", "paper"] = "coarse"
    """Hash grid over positions: `coarse`, or as published (`paper`). `auto`: as published in runs of 5,000
    iterations and more, otherwise coarse."""
    vector_dim: int = 24
    """Size of a photo's vector."""
    unseen: Literal["nearest", "mean"] = "nearest"
    """Look of a view that is not a training photo. `nearest`: the look of the nearest training camera, by
    position (in units of the cameras' spread) and direction. `mean`: the mean vector."""
    opacity_shift: bool = False
    """Let photos hide Gaussians, for things that appear in one photo only. It costs a second rendering."""


class AppearanceField(nn.Module):
    """Network that computes the colors of Gaussians under one photo's look; untrained, it changes nothing.

    Vectors belong to the training photos by their `names`: a checkpoint's vectors stay with their photos
    whichever photos the present run has, and new photos get fresh vectors. `center` and `radius` (the
    distance from it that contains most of the scene) are in world units; `generator` draws the initial
    weights and vectors.
    """

    def __init__(
        self,
        config: AppearanceConfig,
        names: Sequence[str],
        center: Float[Tensor, "3"],
        radius: float,
        *,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.config = config
        self.grid = HashGrid(3, *GRIDS[config.preset], generator=generator)
        inputs = self.grid.output_dim + 3 + config.vector_dim
        # The first layer is split in two: the photo's part is the same for all Gaussians, and computed once.
        self.from_gaussian = linear(inputs - config.vector_dim, HIDDEN, generator, fan_in=inputs)
        self.from_photo = linear(config.vector_dim, HIDDEN, generator, bias=False, fan_in=inputs)
        self.hidden = linear(HIDDEN, HIDDEN, generator)
        # This layer has its own generator, so that the given one draws the same numbers as without it.
        self.output = linear(HIDDEN, 4 if config.opacity_shift else 3, torch.Generator().manual_seed(0))
        for parameter in self.output.parameters():
            nn.init.zeros_(parameter)
        vectors = FIRST_DEVIATION * torch.randn(len(names), config.vector_dim, generator=generator)
        self.vectors = nn.Parameter(vectors)

        self.center: Tensor
        self.radius: Tensor
        self.positions: Tensor
        self.directions: Tensor
        self.learned: Tensor
        self.register_buffer("center", center.detach().clone())
        # A scene without extent has no length of its own: use 1.
        self.register_buffer("radius", center.new_tensor(radius or 1.0))
        self.register_buffer("positions", torch.zeros(len(names), 3))
        self.register_buffer("directions", torch.zeros(len(names), 3))
        self.register_buffer("learned", torch.zeros(len(names), dtype=torch.bool))
        self._set_names(names)

    def forward(
        self,
        gaussians: Gaussians,
        colors: Float[Tensor, "n 3"],
        vector: Float[Tensor, " v"],
        visible: Int[Tensor, " m"],
        seed: int | None = None,
    ) -> tuple[Float[Tensor, "n 3"], Gaussians]:
        """Compute colors, and with `opacity_shift` also opacities, under a photo's vector. Positions get no
        gradient.

        Args:
            gaussians: Gaussians in the world frame, which are returned unchanged without `opacity_shift`.
            colors: colors before the shift, at least 0, as after it.
            vector: the photo's vector.
            visible: rows of the Gaussians to change; the others stay as they are.
            seed: seed of the opacity shift's noise in training; None for no noise.
        """
        base = colors[visible]
        features = torch.cat((self.grid(self._unit_cube(gaussians.means[visible])), base), 1)
        hidden = F.relu(self.from_gaussian(features) + self.from_photo(vector))
        shift = self.output(F.relu(self.hidden(hidden)))
        colors = colors.index_copy(0, visible, (base + shift[:, :3]).clamp_min(0.0))
        if self.config.opacity_shift:
            before = gaussians.opacities
            drop = self._binary_concrete(shift[:, 3] + FIRST_LOGIT, visible, len(before), seed)
            opacities = before.index_copy(0, visible, (before[visible] - drop).clamp(0.0, 1.0))
            gaussians = replace(gaussians, opacities=opacities)
        return colors, gaussians

    def vector(self, name: str) -> Float[Tensor, " v"]:
        """Return the vector of a training photo. Raises UserError if none has this name."""
        if name not in self._rows:
            known = some(self.names, 5)
            raise UserError(f"{name} is not a training photo of this scene: choose one of {known}")
        return self.vectors[self._rows[name]]

    @torch.no_grad()
    def remember(self, name: str, position: Float[Tensor, "3"], direction: Float[Tensor, "3"]) -> None:
        """Record that a photo is used in training, and its camera's position and unit viewing direction."""
        row = self._rows[name]
        self.positions[row], self.directions[row] = position, direction
        self.learned[row].fill_(True)  # with an assignment, some versions of torch copy from the CPU and wait

    def of_photo(self, name: str) -> Look:
        """Return the look of a training photo. Raises UserError if none has this name."""
        return Look(self, self.vector(name).detach())

    def of_view(self, camera: Camera) -> Look:
        """Choose a look for a view that is not a training photo, by the rule `AppearanceConfig.unseen`."""
        there = camera.to(self.vectors.device)
        return Look(self, self.vector_of_view(there.position, there.view_matrix[2, :3]).detach())

    def vector_of_view(
        self, position: Float[Tensor, "3"], direction: Float[Tensor, "3"]
    ) -> Float[Tensor, " v"]:
        """Return a vector for a view that is not a training photo, by the rule `AppearanceConfig.unseen`. It
        is zero before any training."""
        vectors = self.vectors[self.learned]
        if len(vectors) == 0:
            return self.vectors.new_zeros(self.config.vector_dim)
        if self.config.unseen == "mean":
            return vectors.mean(0)
        positions = self.positions[self.learned]
        spread = (positions - positions.mean(0)).norm(dim=1).mean().clamp_min(1e-9)
        moved = (positions - position).norm(dim=1) / spread
        turned = (self.directions[self.learned] - direction).norm(dim=1)
        return vectors[(moved.square() + turned.square()).argmin()]

    def _unit_cube(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Convert positions to grid coordinates in [0, 1]. Space is contracted to a ball (Mip-NeRF 360,
        Barron et al. 2022): the scene fills the inner half, and everything out to the sky the rest."""
        x = (means.detach() - self.center) / self.radius
        largest = x.abs().amax(1, keepdim=True).clamp_min(1.0)
        # Lengths are in units of the largest component, since the squares of far positions would overflow.
        distance = largest * (x / largest).norm(dim=1, keepdim=True).clamp_min(1 / largest)
        return 0.5 + 0.25 * (x / distance) * (2 - 1 / distance)

    def _binary_concrete(
        self, logits: Float[Tensor, " m"], visible: Int[Tensor, " m"], count: int, seed: int | None
    ) -> Float[Tensor, " m"]:
        """Sample a relaxed coin per Gaussian, which is close to 0 or 1 (Maddison et al. 2017). With noise u,
        it is sigmoid((logit + log u − log(1 − u)) / temperature); without a seed, u is 1/2."""
        if seed is not None:
            # Noise for all Gaussians is sampled on the CPU, so it depends neither on device nor visibility.
            noise = torch.rand(count, generator=torch.Generator().manual_seed(seed))
            shift = to_device(torch.logit(noise, eps=1e-6).to(logits.dtype), logits.device)
            logits = logits + shift[visible]
        return torch.sigmoid(logits / TEMPERATURE)

    # ── checkpoints ─────────────────────────────────────────────────────────────────────────────────

    def _set_names(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._rows = {name: row for row, name in enumerate(self.names)}

    def get_extra_state(self) -> list[str]:
        return self.names

    def set_extra_state(self, state: list[str]) -> None:
        """Do nothing, since `_load_from_state_dict` restores the names together with their rows."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args) -> None:
        """Load the checkpoint's photos, and append those of this run that it lacks."""
        saved = state_dict.get(f"{prefix}_extra_state")
        if saved is not None:
            known = set(saved)
            new = [row for row, name in enumerate(self.names) if name not in known]
            for key in ("vectors", "positions", "directions", "learned"):
                tensor = getattr(self, key).data
                rows = state_dict[prefix + key].to(tensor)
                state_dict[prefix + key] = torch.cat((rows, tensor[new]))
                getattr(self, key).data = torch.empty_like(state_dict[prefix + key])
            self._set_names([*saved, *(self.names[row] for row in new)])
        super()._load_from_state_dict(state_dict, prefix, *args)


@dataclass(frozen=True, eq=False)
class Look:
    """Lighting of one photo."""

    field: AppearanceField
    """Trained field, whose weights no longer change."""
    vector: Float[Tensor, " v"]
    """Appearance code of the photo."""

    @torch.no_grad()
    def apply(self, splats: Splats, camera: Camera, everywhere: bool = True) -> Splats:
        """Return the Gaussians (in the field's world frame) under this lighting, in the colors that one
        camera sees; `everywhere` relights all of them, not only those that it may see. The camera's position
        matters only if colors depend on it, because the change of lighting depends on the visible color."""
        camera = camera.to(splats.means.device)
        seen = torch.arange(len(splats), device=splats.means.device)
        if not everywhere:
            seen = seen[in_view(camera, splats.means, splats.scales)]
        colors, lit = self.field(splats.gaussians, splats.colors(camera.position), self.vector, seen)
        return replace(splats, opacities=lit.opacities, harmonics=harmonics_of(colors))


def render_in_look(
    splats: Splats,
    camera: Camera,
    look: Look | None,
    channels: Float[Tensor, "n d"] | None = None,
    *,
    background: Float[Tensor, "3"] | None = None,
) -> Rendering:
    """Render Gaussians (world frame) under a photo's lighting, or in their own colors without a look; for the
    other arguments see `render`. Coverage, depth and further channels belong to the scene, not to a photo. If
    a look changes opacities, they are rendered separately, with the opacities of the scene."""
    draw = partial(render, camera=camera, background=background)
    lit = splats if look is None else look.apply(splats, camera, everywhere=False)
    if lit.opacities is splats.opacities:
        return draw(lit, channels=channels)
    return replace(draw(splats, channels=channels), rgb=draw(lit).rgb)
