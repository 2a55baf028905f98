"""Language in large 3D scenes: Lang3D-XL as a nerfstudio plugin.

Each name loads its module at first use, so that importing the package costs nothing; only `load_scene` needs
nerfstudio.
"""

from importlib import import_module
from typing import Any

from lang3dxl_ns.common.console import silence_libraries

_PUBLIC = {
    "load_scene": "plugin.load_scene",
    "attach": "attach.attach",
    "Scene": "query.scene",
    "together": "query.match",
    "QueryConfig": "query.scene",
    "Camera": "scene.camera",
    "Gaussians": "rendering",
    "Rendering": "rendering",
    "rasterize": "rendering",
    "AttenuatedDownsampler": "components.downsampler",
    "DownsamplerConfig": "components.downsampler",
    "HashGrid": "components.hash_grid",
    "SemanticField": "components.semantic_field",
    "SemanticFieldConfig": "components.semantic_field",
    "UserError": "common.errors",
}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "load_scene":  # imports nerfstudio, whose imports warn of what a user can do nothing about
        silence_libraries()
    return getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)
