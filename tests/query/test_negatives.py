"""What a prompt competes with: other contents of photos and other parts of buildings, but not itself or its
whole."""

import pytest

from lang3dxl_ns.query.negatives import NEGATIVES, competitors
from lang3dxl_ns.query.vocabulary import synonyms_of


def against(text: str) -> set[str]:
    return {NEGATIVES[i] for i in competitors(NEGATIVES, [text, *synonyms_of(text)])}


@pytest.mark.parametrize(
    ("text", "name"),
    [
        *[("windows", "window"), ("rose window", "window"), ("oculus", "window"), ("lancets", "window")],
        *[("portals", "door"), ("the entrance", "door"), ("gates", "door"), ("doorway", "door")],
        *[("towers", "tower"), ("minarets", "tower"), ("belfry", "tower"), ("steeple", "tower")],
        *[("spires", "spire"), ("steeple", "spire"), ("fleche", "spire")],
        *[("domes", "dome"), ("cupola", "dome"), ("roofs", "roof"), ("trees", "tree")],
    ],
)
def test_a_prompt_does_not_compete_with_what_it_means(text, name):
    assert name not in against(text)


@pytest.mark.parametrize("part", ["windows", "portals", "doors", "rose window", "oculus"])
def test_a_part_does_not_compete_with_its_whole_but_with_other_parts(part):
    others = {"spire", "dome", "window" if "door" in part or "portal" in part else "door"}
    assert "tower" not in against(part) and others <= against(part)


@pytest.mark.parametrize("whole", ["towers", "spires", "domes"])
def test_a_whole_competes_with_its_parts(whole):
    assert {"window", "door", "wall", "sky", "object"} <= against(whole)


def test_a_prompt_that_names_everything_competes_with_everything():
    assert competitors(["window", "door"], ["window door"]) == [0, 1]


@pytest.mark.parametrize(
    ("hyphened", "spaced"),
    [("bell-tower", "bell tower"), ("rose-window", "rose window"), ("flying-buttress", "flying buttress")],
)
def test_a_hyphen_is_a_space(hyphened, spaced):
    assert against(hyphened) == against(spaced) and synonyms_of(hyphened) == synonyms_of(spaced)
