"""Language in large 3D scenes: Lang3D-XL as a nerfstudio plugin.

Each public name loads its module at first use, so importing the package costs nothing. Only `load_scene` for
runs without a scene file needs nerfstudio.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from lang3dxl_ns.common.threads import sleep_soon

_PUBLIC = {
    "load_scene": "open_scene",
    "attach": "attachment.attach",
    "Scene": "query.scene",
    "Match": "query.match",
    "Found": "query.match",
    "train": "training.fit",
    "reconstruct": "scene.reconstruct:reconstruct_scene",
    "rasterize": "rendering",
    "UserError": "common.errors",
}
__all__ = list(_PUBLIC)
try:
    __version__ = version("lang3dxl-ns")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "0"

sleep_soon()


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, member = _PUBLIC[name].partition(":")
    return getattr(import_module(f"{__name__}.{module}"), member or name)
