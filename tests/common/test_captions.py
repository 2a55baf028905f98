"""Captions: every letter is shown, within the width."""

import pytest

from lang3dxl_ns.common.captions import letters, lines

CAPTIONS = (
    "The western façade of the cathedral with its rose window, seen from the square on a winter day in 1905",
    "Portal",
    "聖" * 100,
    "one " + "w" * 90 + " two",
    "",
)


@pytest.mark.parametrize("caption", CAPTIONS, ids=range(len(CAPTIONS)))
@pytest.mark.parametrize("width", [200, 600])
def test_lines_keep_all_letters_and_the_width(caption, width):
    font = letters(15)
    broken = lines(caption, font, width).split("\n")
    assert "".join("".join(broken).split()) == "".join(caption.split())
    assert all(font.getlength(line) <= width for line in broken)


def test_letters_of_european_languages_are_no_boxes():
    pytest.importorskip("matplotlib", reason="a machine may have no font at all")
    box, *shown = (bytes(letters(20).getmask(letter)) for letter in "\uffffäßéøšżñ—…«»ΩЖ")
    assert box not in shown
