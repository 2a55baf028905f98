"""Every preset that ships can be read, and a wrong name says which exist."""

import pytest

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.preparation.physical_scale import physical_scales
from lang3dxl_ns.presets import FOLDER, load_preset


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
