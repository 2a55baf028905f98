"""Language in large 3D scenes: Lang3D-XL as a nerfstudio plugin."""
