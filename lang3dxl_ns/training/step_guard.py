"""Step guard: skipping optimizer steps whose loss or gradient is not finite."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping

import torch
from torch import Tensor

from lang3dxl_ns.common.errors import UserError

LARGEST_GRADIENT = 1e18
"""Bound on losses and gradient norms. Adam stores squared gradients: above this norm they overflow float32,
and the parameter never moves again."""


class StepGuard:
    """Guard that counts and reports skipped steps, and gives up after too many in a row."""

    def __init__(self, most_in_a_row: int, log: Callable[[str], None]):
        self.most_in_a_row = most_in_a_row
        self.skipped = 0
        """Number of steps skipped so far in this run."""
        self._in_a_row = 0
        self._log = log
        self._seen: Counter[tuple[str, str]] = Counter()

    def allows(
        self,
        step: int,
        photo: str,
        losses: Mapping[str, Tensor],
        groups: Mapping[str, Iterable[Tensor]],
        scale: float = 1.0,
    ) -> bool:
        """Return whether all losses and all gradients of the parameter groups are finite, by one reduction
        per gradient and one synchronization in all. `scale` is the scale of the gradients under mixed
        precision. Raises UserError after too many broken steps in a row."""
        named = {f"loss {name}": value.detach().float() for name, value in losses.items()}
        for name, parameters in groups.items():
            norms = [torch.linalg.vector_norm(p.grad).float() for p in parameters if p.grad is not None]
            if norms:
                named[f"gradient of {name}"] = torch.stack(norms).sum() / scale
        # The comparison is also false for NaN.
        sound = torch.stack([value.abs() < LARGEST_GRADIENT for value in named.values()])
        if bool(sound.all()):
            self._in_a_row = 0
            return True
        what = ", ".join(name for name, good in zip(named, sound.tolist(), strict=True) if not good)
        self.skipped += 1
        self._in_a_row += 1
        self._seen[photo, what] += 1
        if self._seen[photo, what] == 1:  # a broken photo recurs in every round
            self._log(f"Step {step} is skipped: photo {photo} gives no finite {what}")
        if self._in_a_row >= self.most_in_a_row:
            raise UserError(
                f"{self._in_a_row} steps in a row had no finite loss or gradient (the last, step {step}, "
                f"photo {photo}: {what}). The parameters are intact: check the photos "
                "named above, their masks and targets, or lower the learning rate of these parameters"
            )
        return False

    def summary(self) -> str | None:
        """Summarize the skipped steps in one sentence; None if there were none."""
        if not self.skipped:
            return None
        worst = Counter[str]()
        for (photo, _), count in self._seen.items():
            worst[photo] += count
        photos = ", ".join(f"{photo} ({count})" for photo, count in worst.most_common(5))
        return f"{self.skipped} steps were skipped, most often at {photos}"
