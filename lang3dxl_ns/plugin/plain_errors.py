"""Errors of the user's making end nerfstudio's commands with a message, not a traceback."""

from __future__ import annotations

import sys
from types import TracebackType

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from lang3dxl_ns.common.errors import UserError

_previous_hook = sys.excepthook


def print_user_errors_plainly() -> None:
    """Make commands end on a `UserError` with its message alone, without a traceback."""
    global _previous_hook
    if sys.excepthook is not _print_user_error:
        _previous_hook, sys.excepthook = sys.excepthook, _print_user_error


def _print_user_error(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    if issubclass(kind, UserError):
        CONSOLE.print(f"[bold red]Error:[/bold red] {escape(str(error))}", soft_wrap=True)
    else:
        _previous_hook(kind, error, traceback)
