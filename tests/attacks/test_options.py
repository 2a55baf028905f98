"""Options that make no sense end in one line before any work."""

import math
from copy import deepcopy
from operator import attrgetter
from pathlib import Path

import pytest
import torch

from lab.run_config import run_config
from lang3dxl_ns.cli import main
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.methods import METHODS, lang3dxl
from lang3dxl_ns.plugin.trainer import requested_checkpoint
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.text import TextConfig


@pytest.mark.parametrize(
    "options",
    [
        {"crop_batch": 0},
        {"crop_batch": -1},
        {"dense_tokens": -4},
        {"dense_tokens": 0},
        {"scales": 0},
        {"scales": 1_000_000},
        {"workers": 0},
        {"scale_range": (-0.1, 0.5)},
        {"scale_range": (0.5, 0.1)},
        {"scale_range": (0.0, 0.5)},
        {"scale_range": (math.nan, 0.5)},
        {"scale_range": (0.1, math.inf)},
        {"scale_range": (0.1, 24.0), "scale_mode": "relative"},
        {"scale_range": (1.0, 2.0), "scale_preset": "holyscenes/milano"},
    ],
)
def test_preparations(options):
    with pytest.raises(UserError, match=r"--"):
        PreparationConfig(**options).check()


@pytest.mark.parametrize(
    "options",
    [
        {"camera_res_scale_factor": 0.0},
        {"camera_res_scale_factor": -1.0},
        {"camera_res_scale_factor": math.nan},
        {"cache_gb": -1.0},
        {"cache_gb": math.nan},
        {"read_ahead": -3},
        {"crop_batch": 0},
    ],
)
def test_trainings(options, tmp_path):
    config = deepcopy(lang3dxl.config)
    config.output_dir = tmp_path / "outputs"
    vars(config.pipeline.datamanager).update(options)
    with pytest.raises(UserError, match=r"--"):
        config.set_timestamp()
    assert not config.output_dir.exists()


@pytest.mark.parametrize(("owner", "name", "value"), [("machine", "seed", -1), ("", "max_num_iterations", 0)])
def test_runs(owner, name, value, tmp_path):
    config = deepcopy(lang3dxl.config)
    setattr(getattr(config, owner) if owner else config, name, value)
    with pytest.raises(UserError, match=name.replace("_", "-")):
        config.set_timestamp()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("sky_gaussians", -5), ("sky_gaussians", 1e12), ("sh_degree", -1), ("sh_degree", 4)),
        *(("num_random", 0), ("densify_every", math.nan), ("densify_from", math.inf)),
        *(("random_scale", math.nan), ("cull_alpha_thresh", 2), ("clip_weight", -1), ("warm_up", -1)),
        *(("densify_grad_thresh", math.nan), ("decode_size", (0, 0)), ("decode_size", (9, 2))),
    ],
)
def test_settings_of_the_model(name, value, tmp_path):
    config = deepcopy(lang3dxl.config)
    config.output_dir = tmp_path / "outputs"
    setattr(config.pipeline.model, name, value)
    with pytest.raises(UserError, match=f"--{name.replace('_', '-')} is "):
        config.set_timestamp()
    assert not config.output_dir.exists()


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        ("pipeline.model.semantic_field.hidden_width", 0, "semantic-field.hidden-width is 0"),
        ("pipeline.model.semantic_field.levels", -1, "semantic-field.levels is -1"),
        ("pipeline.model.semantic_field.code_std", math.nan, "code-std is nan"),
        ("pipeline.model.semantic_field.min_resolution", 5_000, "min_resolution 5000 is above"),
        ("pipeline.model.semantic_field.code_dim", 9, "code_dim is 9"),
        ("pipeline.model.downsampler.logit_bound", 0.0, "downsampler.logit-bound is 0.0"),
        ("pipeline.model.appearance.vector_dim", -1, "appearance.vector-dim is -1"),
        ("pipeline.model.decoder.compression.sample", 0, "decoder.compression.sample is 0"),
    ],
)
def test_settings_of_components(path, value, told, tmp_path):
    config = deepcopy(METHODS["lang3dxl-paper"].config)
    config.output_dir = tmp_path / "outputs"
    owner, name = path.rsplit(".", 1)
    setattr(attrgetter(owner)(config), name, value)
    with pytest.raises(UserError, match=told):
        config.set_timestamp()
    assert not config.output_dir.exists()


def test_a_learning_rate_below_zero(tmp_path):
    config = deepcopy(lang3dxl.config)
    config.optimizers["features_dc"]["optimizer"].lr = -1.0
    with pytest.raises(UserError, match=r"features-dc\.optimizer\.lr is -1"):
        config.set_timestamp()


@pytest.mark.parametrize(
    "options",
    [
        {"threshold": math.nan},
        {"threshold": -0.1},
        {"threshold": 1.5},
        {"temperature": 0.0},
        {"temperature": math.nan},
        {"min_alpha": math.nan},
        {"views": 0},
        {"view_side": 0},
    ],
)
def test_questions(options):
    (name,) = options
    with pytest.raises(UserError, match=f"--{name.replace('_', '-')} is"):
        QueryConfig(**options)


def test_a_prompt_needs_something_to_compete_with():
    for negatives in ((), ("",), (" ", "")):
        with pytest.raises(UserError, match="--negatives is empty"):
            TextConfig(negatives=negatives)


def test_a_preset_that_is_no_scene_has_no_crops(scene, tiny_clip, tmp_path):
    options = ["--clip", str(tiny_clip), "--dense", "none", "--cache-dir", str(tmp_path)]
    with pytest.raises(SystemExit, match="the preset synonyms/architecture has no scale-range"):
        main(["prepare", "--data", str(scene), "--scale-preset", "synonyms/architecture", *options])


def test_what_makes_sense_passes():
    PreparationConfig(scale_range=(0.05, 0.5), scale_mode="relative", scales=1, crop_batch=1).check()
    QueryConfig(threshold=0.0)
    QueryConfig(threshold=1.0)


@pytest.mark.parametrize(("name", "value"), [("scale_factor", 0.0), ("scene_scale", math.nan)])
def test_settings_of_the_parser(name, value):
    config = deepcopy(lang3dxl.config)
    setattr(config.pipeline.datamanager.dataparser, name, value)
    with pytest.raises(UserError, match=f"--{name.replace('_', '-')} is .*: give a number"):
        config.set_timestamp()


def test_a_run_in_the_home_is_found(tmp_path, monkeypatch):
    """Shells leave the ~ of --load-dir=~/run as it is."""
    monkeypatch.setenv("HOME", str(tmp_path))
    path = tmp_path / "run" / "step-000000007.ckpt"
    path.parent.mkdir()
    path.touch()
    config = deepcopy(lang3dxl.config)
    config.load_dir = Path("~/run")
    assert requested_checkpoint(config) == path
    config.load_dir, config.load_checkpoint = None, Path("~/run") / path.name
    assert requested_checkpoint(config) == path


def test_a_run_of_the_same_name_keeps_its_checkpoints(tmp_path, scene):
    """A new run would delete all but its own latest one."""

    def config_of_mine(**changes):
        config = run_config(scene, tmp_path, "a", 5, "none", "none")
        config.timestamp, config.load_dir = "mine", changes.pop("load_dir", None)
        vars(config.pipeline.model).update(changes)
        config.set_timestamp()
        return config

    (checkpoints := config_of_mine().get_checkpoint_dir()).mkdir(parents=True)
    torch.save({}, checkpoints / "step-000000400.ckpt")
    with pytest.raises(UserError, match="is of an earlier run: resume it"):
        config_of_mine()
    config_of_mine(load_dir=checkpoints)
    with pytest.raises(UserError, match="clip-weight has no effect"):
        config_of_mine(load_dir=checkpoints, clip_weight=0.0)


def test_two_runs_that_start_in_one_second_have_a_folder_each(tmp_path, scene):
    folders = []
    for _ in range(3):
        config = deepcopy(lang3dxl.config)
        config.output_dir, config.data, config.pipeline.datamanager.clip = tmp_path, scene, "none"
        config.experiment_name = "scene"
        config.pipeline.datamanager.clip = config.pipeline.datamanager.dense = "none"
        config.set_timestamp()
        folders.append(config.get_base_dir())
    assert len(set(folders)) == 3
