"""The panel "Ask the scene" in nerfstudio's viewer."""
