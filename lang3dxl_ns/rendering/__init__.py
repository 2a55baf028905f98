"""Differentiable rendering of Gaussians, on CPU and GPU."""

from lang3dxl_ns.rendering.gaussians import Gaussians, Rendering
from lang3dxl_ns.rendering.rasterize import rasterize
from lang3dxl_ns.rendering.spherical_harmonics import spherical_harmonics
from lang3dxl_ns.scene.camera import Camera

__all__ = ["Camera", "Gaussians", "Rendering", "rasterize", "spherical_harmonics"]
