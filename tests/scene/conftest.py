"""A small scene."""

import pytest
from scenes import write_scene


@pytest.fixture
def folder(tmp_path):
    """Photos photo_000.png … with a binary model."""
    return write_scene(tmp_path / "scene", photos=6, points=60, image_ext="png")
