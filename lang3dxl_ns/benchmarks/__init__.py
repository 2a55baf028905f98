"""Benchmarks of `lang3dxl benchmark`: error beside time and memory."""
