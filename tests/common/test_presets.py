"""Shipped presets: all can be read, and a wrong name lists them."""

import pytest

from lang3dxl_ns import cli
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.presets import FOLDER, load_preset, scene_presets, train_flags
from lang3dxl_ns.preparation.physical_scale import physical_scales


def test_every_scene_has_a_range_that_makes_the_published_number_of_scales():
    counts = {
        p.stem: len(physical_scales(*load_preset(f"holyscenes/{p.stem}")["scale_range"]))
        for p in FOLDER.glob("holyscenes/*.yaml")
    }
    published = {"notre_dame": 5, "st_paul": 5, "milano": 4, "blue_mosque": 5, "badshahi": 8, "hurba": 8}
    assert counts == published


@pytest.mark.parametrize("name", ["holyscenes/atlantis", "../pyproject", "/etc/passwd"])
def test_an_unknown_preset_names_the_known_ones(name):
    with pytest.raises(UserError, match="holyscenes/milano"):
        load_preset(name)


def test_a_preset_that_is_not_a_scene_has_no_flags():
    with pytest.raises(UserError, match="not a preset for training"):
        train_flags("synonyms/architecture")


@pytest.mark.slow
@pytest.mark.nerfstudio
def test_training_takes_the_flags_of_every_scene(capsys):
    """As `ns-train lang3dxl-paper` would parse them, those of the authors' release after a scene's."""
    from copy import deepcopy

    import tyro

    from lang3dxl_ns.methods import lang3dxl_paper

    for path in FOLDER.glob("holyscenes/*.yaml"):
        cli.main(["preset", f"holyscenes/{path.stem}"])
        flags = capsys.readouterr().out.split()
        if path.stem in ("milano", "badshahi"):  # parsing takes seconds; the other four have milano's flags
            cli.main(["preset", "official"])
            flags += capsys.readouterr().out.split()
            settings = tyro.conf.FlagConversionOff[type(lang3dxl_paper.config)]
            config = tyro.cli(settings, args=flags, default=deepcopy(lang3dxl_paper.config))
            iterations = config.max_num_iterations
            assert iterations == (200_000 if path.stem == "badshahi" else 70_000)
            assert config.pipeline.datamanager.scale_preset == f"holyscenes/{path.stem}"
            start = 5_000 if path.stem == "badshahi" else 2_000
            assert config.pipeline.model.densify_from * iterations == pytest.approx(start, abs=1)
            model = config.pipeline.model
            assert model.semantic_ramp * iterations == pytest.approx(15_000, abs=1)
            assert (model.semantic_field.preset, model.dense_weight) == ("official", 0.8)
            assert model.downsampler.logit_bound is None and not model.appearance.opacity_shift
            until = config.optimizers["means"]["scheduler"].until
            assert until * iterations == pytest.approx(30_000, abs=1)
        else:
            assert flags[2:] == train_flags("holyscenes/milano")[2:]


def test_without_a_name_the_scenes_are_listed(capsys):
    cli.main(["preset"])
    assert capsys.readouterr().out.split() == ["official", *scene_presets()]
    assert all(train_flags(name) for name in scene_presets())


def test_lang3dxl_train_takes_the_flags_of_scenes_that_it_has_all_settings_of(capsys):
    for scene in ("milano", "st_paul"):
        cli.main(["preset", f"holyscenes/{scene}", "--command", "train"])
        given = cli._parsed(["train", "photos", *capsys.readouterr().out.split()])
        assert (given.method, given.steps) == ("lang3dxl-paper", 70_000)
        assert given.scale_preset == f"holyscenes/{scene}"
    for name in ("official", "holyscenes/badshahi"):
        with pytest.raises(SystemExit, match="lang3dxl train has no"):
            cli.main(["preset", name, "--command", "train"])
