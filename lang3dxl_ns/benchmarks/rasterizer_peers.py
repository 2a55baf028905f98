"""Other rasterizers for `lang3dxl benchmark rasterizer`, each from a Python file that adapts it."""

import runpy
from collections.abc import Callable, Collection, Iterable
from functools import cache
from pathlib import Path
from typing import TypeAlias

from torch import Tensor

from lang3dxl_ns.benchmarks.rasterizer_scenes import Problem
from lang3dxl_ns.common.errors import UserError

Render: TypeAlias = Callable[[Problem], tuple[Tensor, Tensor]]


def name_peers(files: Iterable[Path], taken: Collection[str]) -> dict[str, Path]:
    """The files by the names they give their rasterizers.

    Raises:
        UserError: a file can't be run, lacks NAME or render, or its name is taken already.
    """
    peers: dict[str, Path] = {}
    for file in files:
        name, _ = load_peer(file)
        if name in peers or name in taken:
            raise UserError(f"{file} names its rasterizer {name!r}, as another is called: change NAME")
        peers[name] = file
    return peers


@cache
def load_peer(file: Path) -> tuple[str, Render]:
    """NAME and render of a peer's file."""
    try:
        defined = runpy.run_path(str(file))
    except Exception as error:
        raise UserError(f"{file} can't be run ({type(error).__name__}: {error}): see --peers") from error
    name, render = defined.get("NAME"), defined.get("render")
    if not isinstance(name, str) or not callable(render):
        raise UserError(f"{file} must define NAME, a string, and render(problem): see --peers")
    return name, render
