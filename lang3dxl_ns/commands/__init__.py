"""Subcommands of `lang3dxl`."""
