"""The demo's picture: its choice of photos, and the placement of its panels."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from lab.landmark.picture import PictureRow, draw_picture, most_telling


def match(score, threshold=0.4):
    return SimpleNamespace(relevancy=score.astype(np.float32), mask=score > threshold, threshold=threshold)


def row(name, *prompts, score=None):
    mask = np.zeros((30, 40), bool)
    mask[5:15, 10:20] = True
    photo = np.full((60, 80, 3), 0.5)
    matches = dict.fromkeys(prompts, match(np.full((30, 40), 0.5) if score is None else score))
    return PictureRow(name, photo, photo, photo, matches, dict.fromkeys(prompts, mask))


def test_photos_are_chosen_for_what_the_others_lack():
    rows = [row("a", "domes"), row("b", "domes", "towers", "windows"), row("c", "spires"), row("d", "domes")]
    assert [r.name for r in most_telling(rows, 2)] == ["b", "c"]
    assert len(most_telling(rows, 9)) == 4


def test_a_prompt_is_painted_where_it_is_found(tmp_path):
    def red(top):
        score = np.full((30, 40), 0.4)
        score[:15] = 0.9 if top else 0.4
        score[15:] = 0.4 if top else 0.9
        draw_picture([row("a", "domes", score=score)], tmp_path / "picture.png")
        image = np.asarray(Image.open(tmp_path / "picture.png").convert("RGB")).astype(int)
        panel = image[:, image.shape[1] * 3 // 4 :]
        color = panel[..., 0] - panel[..., 2]  # gray elsewhere
        half = len(panel) // 2
        return color[:half].clip(0).sum(), color[half:].clip(0).sum()

    upper, lower = red(top=True)
    assert upper > 5 * lower
    upper, lower = red(top=False)
    assert lower > 5 * upper


def test_what_is_found_is_outlined_and_nothing_found_is_not(tmp_path):
    def magenta(score):
        draw_picture([row("a", "domes", score=score)], tmp_path / "picture.png")
        image = np.asarray(Image.open(tmp_path / "picture.png").convert("RGB")).astype(int)
        return ((image - [255, 0, 255]).__abs__().max(2) < 40).nonzero()

    score = np.full((30, 40), 0.2)
    assert not len(magenta(score)[0])
    score[10:20, 10:30] = 0.9
    rows, columns = magenta(score)
    assert len(rows) > 40
    panel = np.ptp(rows) / np.ptp(columns)  # twice as wide as high
    assert panel == pytest.approx(0.5, abs=0.1)


def test_rows_may_show_different_numbers_of_prompts(tmp_path):
    draw_picture([row("a", "domes", "towers"), row("b", "spires")], tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 1000
