"""Differentiable rendering of Gaussians, on CPU and GPU."""

from lang3dxl_ns.rendering.gaussians import Gaussians, Raster
from lang3dxl_ns.rendering.rasterize import Backend, rasterize
from lang3dxl_ns.rendering.spherical_harmonics import spherical_harmonics
from lang3dxl_ns.rendering.splats import Rendering, Splats, composite, harmonics_of, render
from lang3dxl_ns.scene.camera import Camera

__all__ = [
    "Backend", "Camera", "Gaussians", "Raster", "Rendering", "Splats",
    "composite", "harmonics_of", "rasterize", "render", "spherical_harmonics",
]  # fmt: skip
