"""Differentiable rendering of Gaussians, on CPU and GPU."""

from lang3dxl_ns.rendering.gaussians import Gaussians, Raster
from lang3dxl_ns.rendering.rasterize import rasterize
from lang3dxl_ns.rendering.render import Rendering, composite, render
from lang3dxl_ns.rendering.spherical_harmonics import spherical_harmonics
from lang3dxl_ns.rendering.splats import Splats
from lang3dxl_ns.scene.camera import Camera

__all__ = [
    "Camera",
    "Gaussians",
    "Raster",
    "Rendering",
    "Splats",
    "composite",
    "rasterize",
    "render",
    "spherical_harmonics",
]
