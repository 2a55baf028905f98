"""Gaussians to pixels: differentiable, on the CPU as on a GPU."""

from lang3dxl_ns.rendering.gaussians import Camera, Gaussians, Rendering
from lang3dxl_ns.rendering.rasterize import rasterize
from lang3dxl_ns.rendering.spherical_harmonics import spherical_harmonics

__all__ = ["Camera", "Gaussians", "Rendering", "rasterize", "spherical_harmonics"]
