"""The demo's picture: its choice of photos, and the placement of its panels."""

import numpy as np
from PIL import Image

from lang3dxl_ns.demo.picture import PictureRow, draw_picture, most_telling


def row(name, *prompts, score=None):
    mask = np.zeros((30, 40), bool)
    mask[5:15, 10:20] = True
    photo = np.full((60, 80, 3), 0.5)
    relevancy = {prompt: np.full((30, 40), 0.5) if score is None else score for prompt in prompts}
    return PictureRow(
        name, photo, photo, photo, relevancy, dict.fromkeys(prompts, mask), dict.fromkeys(prompts, 0.4)
    )


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


def test_rows_may_show_different_numbers_of_prompts(tmp_path):
    draw_picture([row("a", "domes", "towers"), row("b", "spires")], tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 1000
