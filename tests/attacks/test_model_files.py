"""Damaged folders of models are refused in one sentence, whatever transformers makes of them."""

import json
import os
import shutil
from pathlib import Path

import pytest

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.encoders import load_image_text_encoder

_BUILTIN = Path(__file__).parents[2] / "lang3dxl_ns" / "demo" / "clip"


@pytest.fixture
def folder(tmp_path):
    return shutil.copytree(_BUILTIN, tmp_path / "clip")


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        ("vision_config", "hidden_size", -1),
        ("vision_config", "hidden_size", 0),
        ("vision_config", "hidden_size", "wide"),
        ("vision_config", "num_attention_heads", 0),
        ("vision_config", "num_hidden_layers", -1),
        ("text_config", "num_hidden_layers", 10**9),
        ("vision_config", "patch_size", 0),
        ("vision_config", "hidden_act", "nope"),
        (None, "vision_config", []),
        (None, "dtype", "nope"),
    ],
)
def test_impossible_sizes_and_kinds_are_refused(folder, part, name, value):
    config = json.loads((folder / "config.json").read_text())
    (config[part] if part else config)[name] = value
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match="again"):
        load_image_text_encoder(folder, "cpu")


@pytest.mark.parametrize("content", ["[" * 100_000, "null", "[]"])
@pytest.mark.parametrize("name", ["config.json", "preprocessor_config.json", "tokenizer_config.json"])
def test_json_of_another_shape_is_refused(folder, name, content):
    (folder / name).write_text(content)
    with pytest.raises(UserError, match=str(folder)):
        load_image_text_encoder(folder, "cpu")


@pytest.mark.parametrize(
    "name", ["model.safetensors", "preprocessor_config.json", "tokenizer.json", "added_tokens.json"]
)
def test_pipes_are_refused_rather_than_waited_for(folder, name):
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    with pytest.raises(UserError, match=f"{name} can't be read"):
        load_image_text_encoder(folder, "cpu")
