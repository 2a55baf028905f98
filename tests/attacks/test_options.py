"""Options that make no sense end in one line before any work."""

import math
from copy import deepcopy
from pathlib import Path

import pytest
import torch

from lab.benchmarks.scored_runs import apply_changes
from lab.run_config import run_config
from lang3dxl_ns.cli import main
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
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


MODEL, DATA = "pipeline.model.", "pipeline.datamanager."
SETTINGS = [
    *((f"{DATA}camera_res_scale_factor", value) for value in (0.0, -1.0, math.nan)),
    *((f"{DATA}cache_gb", value) for value in (-1.0, math.nan)),
    *((f"{DATA}read_ahead", -3), (f"{DATA}crop_batch", 0)),
    *((f"{DATA}dataparser.scale_factor", 0.0), (f"{DATA}dataparser.scene_scale", math.nan)),
    (f"{DATA}dataparser.eval_interval", 0),
    *(("machine.seed", -1), ("max_num_iterations", 0)),
    *((f"{MODEL}sky_gaussians", value) for value in (-5, 1e12)),
    *((f"{MODEL}sh_degree", value) for value in (-1, 4)),
    *((f"{MODEL}num_random", 0), (f"{MODEL}densify_every", math.nan), (f"{MODEL}densify_from", math.inf)),
    *((f"{MODEL}random_scale", math.nan), (f"{MODEL}cull_alpha_thresh", 2), (f"{MODEL}clip_weight", -1)),
    *((f"{MODEL}warm_up", -1), (f"{MODEL}densify_grad_thresh", math.nan)),
    *((f"{MODEL}decode_size", value) for value in ((0, 0), (9, 2))),
    *((f"{MODEL}semantic_field.hidden_width", 0), (f"{MODEL}semantic_field.levels", -1)),
    *((f"{MODEL}semantic_field.code_std", math.nan), (f"{MODEL}semantic_field.code_dim", 9)),
    *((f"{MODEL}downsampler.logit_bound", 0.0), (f"{MODEL}appearance.vector_dim", -1)),
    (f"{MODEL}decoder.compression.sample", 0),
]


@pytest.mark.parametrize(("path", "value"), SETTINGS)
def test_settings(path, value, tmp_path):
    config = deepcopy(METHODS["lang3dxl-paper"].config)
    config.output_dir = tmp_path / "outputs"
    apply_changes(config, {path: value})
    name = path.rpartition(".")[2].replace("_", "[-_]")
    with pytest.raises(UserError, match=f"{name} is "):
        config.set_timestamp()
    assert not config.output_dir.exists()


def test_a_resolution_above_another_and_a_learning_rate_below_zero(tmp_path):
    config = deepcopy(lang3dxl.config)
    config.pipeline.model.semantic_field = SemanticFieldConfig(min_resolution=5_000)
    with pytest.raises(UserError, match="min_resolution 5000 is above"):
        config.set_timestamp()
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
    with pytest.raises(UserError, match="holds an earlier run: resume it"):
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
