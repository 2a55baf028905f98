"""Plain messages for user errors in nerfstudio's commands, in place of tracebacks."""

from __future__ import annotations

import sys
from types import TracebackType

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from lang3dxl_ns.common.checks import disk_trouble
from lang3dxl_ns.common.console import accept_any_console
from lang3dxl_ns.common.errors import UserError

_previous_hook = sys.excepthook


def print_user_errors_plainly() -> None:
    """Make commands end on a `UserError` with its message alone, without a traceback, on any console."""
    global _previous_hook
    accept_any_console()
    if sys.excepthook is not _print_user_error:
        _previous_hook, sys.excepthook = sys.excepthook, _print_user_error


def _print_user_error(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    message = disk_trouble(error) if isinstance(error, OSError) else None
    message = str(error) if isinstance(error, UserError) else message
    if message is not None:
        CONSOLE.print(f"[bold red]Error:[/bold red] {escape(message)}", soft_wrap=True)
    else:
        _previous_hook(kind, error, traceback)
