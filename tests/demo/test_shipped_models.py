"""The encoders that come with the package."""

from transformers import CLIPModel

from lang3dxl_ns.preparation import encoders


def test_the_shipped_models_are_small_and_whole():
    clip = encoders.find_model("builtin", encoders.CLIP_OPTION).folder
    dense = encoders.find_model("builtin", encoders.DENSE_OPTION).folder
    assert sum(path.stat().st_size for path in clip.iterdir()) <= 8.2e6
    assert sum(path.stat().st_size for path in dense.iterdir()) <= 8e6
    assert CLIPModel.from_pretrained(clip).config.vision_config.image_size <= 64
