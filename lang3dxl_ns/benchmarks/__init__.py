"""What `lang3dxl benchmark` runs: error beside time and memory."""
