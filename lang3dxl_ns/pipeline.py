"""The pipeline: data manager and model together, with errors that a person can read."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from lang3dxl_ns.datamanager import Lang3DXLDataManager, Lang3DXLDataManagerConfig
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.model import Lang3DXLModel, Lang3DXLModelConfig


@dataclass
class Lang3DXLPipelineConfig(VanillaPipelineConfig):
    """Configuration of the pipeline."""

    _target: type = field(default_factory=lambda: Lang3DXLPipeline)
    datamanager: Lang3DXLDataManagerConfig = field(default_factory=Lang3DXLDataManagerConfig)
    model: Lang3DXLModelConfig = field(default_factory=Lang3DXLModelConfig)


class Lang3DXLPipeline(VanillaPipeline):
    """nerfstudio's pipeline; loads checkpoints strictly."""

    datamanager: Lang3DXLDataManager
    model: Lang3DXLModel
    last_losses: dict[str, Tensor]
    """The weighted losses of the latest training step."""

    def __init__(self, *args, **kwargs):
        print_user_errors_plainly()
        super().__init__(*args, **kwargs)

    def get_train_loss_dict(self, step: int):
        """Outputs, losses and metrics of the next photo."""
        outputs, self.last_losses, metrics = super().get_train_loss_dict(step)
        return outputs, self.last_losses, metrics

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool | None = None):  # type: ignore[override]
        """Load a checkpoint; whatever does not fit is an error (nerfstudio would silently leave it out)."""
        state = {key.removeprefix("_model."): v for key, v in state_dict.items() if key.startswith("_model.")}
        try:
            self.model.load_state_dict(state, strict=True)
        except (RuntimeError, KeyError) as error:
            raise UserError(
                f"the checkpoint does not fit this configuration: {error}. "
                f"Load it with the config.yml beside it, or with the options that it was trained with"
            ) from error


_previous_hook = sys.excepthook


def print_user_errors_plainly() -> None:
    """Let a command end on a `UserError` with its message alone, without a traceback."""
    global _previous_hook
    if sys.excepthook is not _print_user_error:
        _previous_hook, sys.excepthook = sys.excepthook, _print_user_error


def _print_user_error(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    if issubclass(kind, UserError):
        CONSOLE.print(f"[bold red]Error:[/bold red] {error}", soft_wrap=True)
    else:
        _previous_hook(kind, error, traceback)
