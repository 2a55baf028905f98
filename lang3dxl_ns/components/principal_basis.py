"""Principal components of features: the few directions in which the features of one scene differ."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class PrincipalBasis:
    """Affine subspace of features: mean and orthonormal directions, in order of decreasing variance."""

    mean: Float[Tensor, " c"]
    axes: Float[Tensor, "c r"]

    @classmethod
    def of(cls, maps: Iterable[Float[Tensor, "*pixels c"]], most: int) -> PrincipalBasis:
        """Compute the first `most` principal components of all rows of all maps, which are read once. Rows
        with a value that isn't finite are left out. Moments are merged in float64 (Chan, Golub & LeVeque
        1983). Raises ValueError if no row is left."""
        count, mean, scatter = 0, torch.zeros(()), torch.zeros(())
        for values in maps:
            rows = values.flatten(0, -2).double()
            rows = rows[rows.isfinite().all(1)]
            if not len(rows):
                continue
            own = rows.mean(0)
            centered, step, both = rows - own, own - mean, count + len(rows)
            scatter = scatter + centered.T @ centered + count * len(rows) / both * step.outer(step)
            mean, count = mean + step * len(rows) / both, both
        if not count:
            raise ValueError("no feature is finite")
        _, axes = torch.linalg.eigh(scatter)
        return cls(mean.float(), axes[:, -most:].flip(1).float().contiguous())

    def to(self, like: Tensor) -> PrincipalBasis:
        """Return the basis in the number type and on the device of a tensor."""
        return PrincipalBasis(self.mean.to(like), self.axes.to(like))

    def coordinates(self, features: Float[Tensor, "*batch c"]) -> Float[Tensor, "*batch r"]:
        """Compute the coordinates of the subspace's nearest points to features."""
        return (features - self.mean) @ self.axes

    def features(self, coordinates: Float[Tensor, "*batch r"]) -> Float[Tensor, "*batch c"]:
        """Compute the features with these coordinates."""
        return self.mean + coordinates @ self.axes.T
