"""What a run of training changes: Gaussians, their parts, and the progress; the scene so far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isqrt
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import Parameter
from torch.optim import Optimizer

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.targets import SceneFacts
from lang3dxl_ns.rendering import Splats, harmonics_of
from lang3dxl_ns.rendering.rasterize import Backend
from lang3dxl_ns.scene.camera import Camera, view_matrix
from lang3dxl_ns.training import gaussians as of_training
from lang3dxl_ns.training.densify import Densification
from lang3dxl_ns.training.parts import Extent, Parts
from lang3dxl_ns.training.settings import TrainingSettings


@dataclass(frozen=True, eq=False)
class PhotoCamera:
    """Camera of a training photo before its refinement, on the CPU."""

    pose: Float[Tensor, "3 4"]
    """Camera → world (x right, y up, z backward), world units."""
    intrinsics: Float[Tensor, "3 3"]
    """Intrinsic matrix, pixels."""
    width: int
    height: int
    photo: int | None = None
    """Number of the training photo; None for a view that is no training photo's."""

    def camera(self, pose: Float[Tensor, "3 4"] | None = None) -> Camera:
        """Return the rasterizer's camera, at this pose or at a refined one."""
        view = view_matrix(self.pose if pose is None else pose)
        return Camera(view, self.intrinsics, self.width, self.height)


@dataclass(eq=False)
class Training:
    """Gaussians and their parts in training, with the run's progress."""

    settings: TrainingSettings
    """Settings, fitted to the run's length."""
    facts: SceneFacts
    extent: Extent
    gaussians: nn.ParameterDict
    """Parameters of the Gaussians; see `gaussians.initial_gaussians`. Semantics add `codes`."""
    parts: Parts
    densification: Densification
    statistics: dict[str, Any] = field(default_factory=lambda: {"grad2d": None, "count": None})
    """What densification has observed since it last took place."""
    optimizers: Mapping[str, Optimizer] = field(default_factory=dict)
    step: int = 0
    """The present iteration."""
    step_is_sound: bool = True
    """Whether the iteration's losses and gradients are finite."""
    codes_have_begun: bool = False
    """Whether training has reached the codes; part of a checkpoint's run state."""
    seen: dict[str, Any] = field(default_factory=dict)
    """`Raster.info` of the iteration's rendering, between `step.render` and `step.finish`."""

    @staticmethod
    def begin(
        settings: TrainingSettings, facts: SceneFacts, points: tuple[Tensor, Tensor] | None
    ) -> Training:
        """Build Gaussians and parts on the CPU, from the scene's points (world units) and their colors
        (bytes) unless the settings want random ones. Settings without view dependence change in place."""
        if not facts.wants("view dependence", settings.view_dependence):
            settings.sh_degree = 0
        points = None if settings.random_init else points
        means, colors = of_training.seed_positions(points, settings.num_random, settings.random_scale)
        extent = of_training.center_and_radius(means)
        first = of_training.initial_gaussians(means, colors, settings.sky_gaussians, settings.sh_degree)
        gaussians, densification = nn.ParameterDict(first), Densification.of(settings)
        densification.cameras, densification.free = facts.positions, of_training.FREE * extent[1]
        parts = Parts.build(settings, facts, gaussians, extent)
        made = Training(settings, facts, extent, gaussians, parts, densification)
        made.hold_sky()
        return made

    def hold_sky(self) -> None:
        """Keep densification from the Gaussians of the present sky."""
        self.densification.still = 0 if self.parts.sky is None else len(self.parts.sky)

    @property
    def means(self) -> Tensor:
        """Centers of the Gaussians [n, 3], world units."""
        return self.gaussians["means"]

    @property
    def device(self) -> torch.device:
        """The device of the Gaussians."""
        return self.gaussians["means"].device

    @property
    def backend(self) -> Backend:
        """The requested rasterizer; only a GPU has a choice."""
        return self.settings.rasterizer if self.gaussians["means"].is_cuda else "auto"

    @property
    def antialiased(self) -> bool:
        """Whether Gaussians smaller than a pixel are dimmed by what the screen-space blur adds to them."""
        return self.settings.rasterize_mode == "antialiased"

    @property
    def carried(self) -> Float[Tensor, "n d"] | None:
        """Semantic values that Gaussians carry; None if there are none (yet)."""
        return None if self.parts.semantics is None else self.parts.semantics.decoder.carried(self.gaussians)

    @property
    def learns_from_renderings(self) -> bool:
        """Whether semantics are trained with the scene instead of being gathered afterwards."""
        return self.parts.semantics is not None and not self.parts.semantics.decoder.needs_lifting

    @property
    def learns_words_at_the_end(self) -> bool:
        """Whether semantics are gathered from the photos after the last iteration."""
        return self.parts.semantics is not None and self.parts.semantics.decoder.needs_lifting

    @property
    def warm_up_is_over(self) -> bool:
        """Whether the present iteration trains more than colors."""
        return self.step >= self.settings.warm_up * self.settings.total_steps

    @property
    def degree(self) -> int | None:
        """Degree of the harmonics in use: it rises by one every 1,000 iterations, or every tenth of a run of
        under 10,000. None: there are none."""
        c = self.settings
        interval = max(min(c.sh_degree_interval, c.total_steps // 10), 1)
        return min(self.step // interval, c.sh_degree) if c.sh_degree > 0 else None

    def pose(self, view: PhotoCamera) -> Float[Tensor, "3 4"]:
        """Return camera → world, refined for a training photo. Without refinement it stays on the CPU."""
        if self.parts.cameras is None or view.photo is None:
            return view.pose
        # A slice is used, since an index would be copied to the GPU first.
        return self.parts.cameras(view.pose[None], slice(view.photo, view.photo + 1))[0]

    def background(self) -> Float[Tensor, "3"]:
        """Return the color behind the scene in this iteration, which may be drawn at random."""
        if self.settings.background_color == "random":
            return torch.rand(3, device=self.device)
        return torch.full((3,), float(self.settings.background_color == "white"), device=self.device)

    def groups(self) -> dict[str, list[Parameter]]:
        """Return the parameters to optimize: a group per Gaussian property, and those of the parts."""
        names = [name for name in self.gaussians if name != "codes" or self.learns_from_renderings]
        groups = {name: [self.gaussians[name]] for name in names} | self.parts.groups()
        return {name: parameters for name, parameters in groups.items() if parameters}

    @torch.no_grad()
    def splats(self) -> Splats:
        """Return the present Gaussians, which share memory with this run."""
        g = {name: parameter.detach() for name, parameter in self.gaussians.items()}
        if self.degree is None:
            harmonics = harmonics_of(torch.sigmoid(g["features_dc"]))
        else:
            harmonics = of_training.harmonics(g)[:, : (self.degree + 1) ** 2]
        gaussians = vars(of_training.activated(g))
        return Splats(**gaussians, harmonics=harmonics, antialiased=self.antialiased, backend=self.backend)

    def to(self, device: torch.device | str) -> None:
        """Move Gaussians and parts to a device, in place."""
        for module in (self.gaussians, *self.parts.modules().values()):
            module.to(device)

    def tensors(self) -> dict[str, Any]:
        """Return all tensors of Gaussians and parts by name, as in checkpoints."""
        modules = {"gauss_params": self.gaussians, **self.parts.modules()}
        found = {f"{m}.{n}": v for m, module in modules.items() for n, v in module.state_dict().items()}
        if (semantics := self.parts.semantics) is not None:
            found |= {"clip_mean": semantics.clip_mean, "dense_mean": semantics.dense_mean}
        return found

    def load(self, tensors: Mapping[str, Any]) -> None:
        """Load `tensors` of a run with the same settings."""
        self.match(tensors)
        for name, module in {"gauss_params": self.gaussians, **self.parts.modules()}.items():
            own = {k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")}
            module.load_state_dict(own)

    def match(self, state: Mapping[str, Any]) -> None:
        """Give Gaussians and parts the shapes of a checkpoint's tensors, of any number of Gaussians, with or
        without semantics. Parameters are resized in place: the optimizers hold them, and new ones would never
        be trained. Raises UserError if the checkpoint is damaged or contradicts the settings."""
        g = self.gaussians
        self.parts = self.parts.matching(state, self.settings, self.facts, g, self.extent)
        self.hold_sky()
        self.settings.sh_degree = isqrt(state["gauss_params.features_rest"].shape[1] + 1) - 1
        for name, parameter in g.items():
            saved = state[f"gauss_params.{name}"]
            first = 2 if name == "features_rest" else 1
            inner, expected = saved.shape[first:], parameter.shape[first:]
            if inner != expected or saved.shape[:1] != state["gauss_params.means"].shape[:1]:
                raise UserError(
                    f"the checkpoint's {name} have the shape {list(saved.shape)}: it is damaged, or from "
                    "another method; copy it again, or pass a run of ns-train lang3dxl"
                )
            parameter.data = torch.zeros(saved.shape, dtype=parameter.dtype, device=parameter.device)

    def progress(self) -> dict[str, Any]:
        """Collect densification statistics, whether codes have begun, and the random generators' states, all
        in types that torch's weights-only loader accepts."""
        return {
            "strategy": dict(self.statistics),
            "codes_have_begun": self.codes_have_begun,
            "random": torch.get_rng_state(),
            "random_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        }

    def restore(self, progress: Mapping[str, Any]) -> None:
        """Restore `progress` on this run's device, whichever device it was saved from."""
        self.statistics = {
            name: value.to(self.device) if isinstance(value, Tensor) else value
            for name, value in progress["strategy"].items()
        }
        self.codes_have_begun = progress["codes_have_begun"]
        torch.set_rng_state(progress["random"])
        if torch.cuda.is_available() and len(progress["random_cuda"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(progress["random_cuda"])
