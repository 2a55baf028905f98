"""What people type after `lang3dxl`."""
