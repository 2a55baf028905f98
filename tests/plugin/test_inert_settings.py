"""Settings without effect are not offered, and an error if they are set."""

from copy import deepcopy

import pytest
import tyro

from lab.benchmarks.scored_runs import apply_changes
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.downsampler import DownsamplerConfig
from lang3dxl_ns.methods import lang3dxl
from lang3dxl_ns.plugin.inert_settings import OF_COLMAP, OF_IMAGE_CACHES, OF_SPLATFACTO, check_inert


def changed(path, value):
    config = deepcopy(lang3dxl.config)
    apply_changes(config, {path: value})
    return config


def test_the_help_does_not_offer_them(capsys):
    with pytest.raises(SystemExit):
        tyro.cli(
            tyro.conf.SuppressFixed[type(lang3dxl.config)], default=deepcopy(lang3dxl.config), args=["--help"]
        )
    said = "".join(capsys.readouterr().out.split()).replace("│", "")
    for owner, names in (("model", OF_SPLATFACTO), ("datamanager", OF_IMAGE_CACHES)):
        options = [f"--pipeline.{owner}.{name.replace('_', '-')}" for name in names if name != "prompt"]
        assert not [option for option in options if option in said]
    assert "model.densify-from" in said and "manager.clip" in said
    assert OF_COLMAP


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("pipeline.model.clip_weight", 0.0),
        ("pipeline.model.dense_weight", 0.5),
        ("pipeline.model.decode_size", (80, 120)),
        ("pipeline.model.warm_up", 0.5),
        ("pipeline.model.codes_from", "photos"),
        ("pipeline.model.feature_gradient_to_geometry", True),
        ("pipeline.model.downsampler", DownsamplerConfig(hidden=8)),
        ("pipeline.model.semantic_field.code_std", 0.1),
        ("pipeline.datamanager.regions", "felzenszwalb"),
    ],
)
def test_setting_one_is_an_error_that_names_it(path, value, tmp_path):
    config = changed(path, value)
    config.output_dir = tmp_path
    with pytest.raises(UserError, match=f"--{path.replace('_', '-')} has no effect"):
        config.set_timestamp()
    assert not list(tmp_path.iterdir())


def test_what_is_trained_with_the_scene_may_set_its_weights():
    config = changed("pipeline.model.decoder.name", "paper")
    config.pipeline.model.clip_weight = 0.0
    config.pipeline.datamanager.regions = "felzenszwalb"
    check_inert(config.pipeline.model, config.pipeline.datamanager, config.optimizers)
    plain = changed("pipeline.datamanager.regions", "none")
    check_inert(plain.pipeline.model, plain.pipeline.datamanager, plain.optimizers)


def test_an_unknown_decoder_is_refused_with_the_names_there_are():
    config = changed("pipeline.model.decoder.name", "fancy")
    with pytest.raises(UserError, match="unknown feature decoder 'fancy': choose one of gathered, paper"):
        check_inert(config.pipeline.model, config.pipeline.datamanager, config.optimizers)


def test_rates_of_semantics_that_are_trained_with_the_scene_are_an_error_without_them(tmp_path):
    config = deepcopy(lang3dxl.config)
    config.output_dir, config.optimizers["codes"]["optimizer"].lr = tmp_path, 0.5
    with pytest.raises(UserError, match=r"--optimizers\.codes has no effect"):
        config.set_timestamp()
    config.pipeline.model.decoder.name = "paper"
    check_inert(config.pipeline.model, config.pipeline.datamanager, config.optimizers)
    others = deepcopy(lang3dxl.config)
    others.optimizers["means"]["optimizer"].lr = 0.5
    check_inert(others.pipeline.model, others.pipeline.datamanager, others.optimizers)
