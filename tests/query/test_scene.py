"""Queries on a scene with known answers."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from painted_scene import DISTANCE, DOME, WINDOWS, fill, painted_gaussians, painted_scene, render, word_at
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.scene import QueryConfig
from lang3dxl_ns.scene.camera import camera_to_world


@pytest.fixture(scope="module")
def scene():
    return painted_scene()


def painted(camera, word: int) -> torch.Tensor:
    """Pixels of a camera whose middle shows a word."""
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones(rows.shape)], -1)
    seen = DISTANCE * pixels @ camera.intrinsics.inverse().T  # in the camera's frame
    points = (seen - camera.view_matrix[:3, 3]) @ camera.view_matrix[:3, :3]
    return word_at(points.reshape(-1, 3)[:, :2]).view(rows.shape) == word


def wider(mask: torch.Tensor) -> torch.Tensor:
    """And the pixels around."""
    return F.max_pool2d(mask[None].float(), 3, 1, 1)[0].bool()


def test_words_are_found_where_they_are_painted(scene):
    matches = scene.query(["dome; window"], "all/0003.jpg")
    for match, word in zip(matches, (1, 2), strict=True):
        there = painted(match.view.camera, word)
        inside = ~wider(~there)  # a border is mixed
        assert inside.any() and match.mask[inside].all()
        assert not (match.mask & ~wider(there)).any()
        assert match.relevancy.shape == (96, 96)
        assert match.relevancy.min() >= 0 and match.relevancy.max() <= 1
        column, row = match.peak
        assert match.mask[row, column]
        assert match.score == pytest.approx(float(match.relevancy.max()))


def test_nothing_is_found_where_nothing_is_seen(scene):
    match = scene.query("object", "all/0003.jpg")[0]
    empty = match.view.alpha == 0
    assert empty.any()
    assert (match.relevancy[empty] == 0).all() and not match.mask[empty].any()


def test_several_prompts_share_one_rendering(scene):
    calls = []
    counting = painted_scene(render=lambda *what: calls.append(what) or render(*what))
    matches = counting.query(["dome", "window; wall"], "all/0003.jpg")
    assert len(matches) == 3 and len(calls) == 1
    assert matches[0].view is matches[2].view


def test_a_negative_takes_its_pixels_away(scene):
    alone, against = scene.query(['dome; dome not "domes"'], "right/0002.jpg")
    assert alone.mask.any() and not against.mask.any()


def test_a_camera_may_be_named_posed_or_given(scene):
    camera = scene.file.photo("0002").camera
    pose = camera_to_world(camera.view_matrix)
    square = torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]])])
    maps = [
        scene.query("dome", place)[0].relevancy for place in ("right/0002.jpg", "0002", camera, pose, square)
    ]
    assert all(torch.equal(maps[0], other) for other in maps[1:])


def test_mistakes_are_reported(scene):
    with pytest.raises(UserError, match=r"no photo 'left/001.jpg'.*left/0001.jpg"):
        scene.query("dome", "left/001.jpg")
    with pytest.raises(UserError, match="empty"):
        scene.query([], "0002")
    with pytest.raises(UserError, match="one at a time"):
        scene.query_gaussians("dome; wall")
    with pytest.raises(UserError, match=r"\[3, 4\]"):
        scene.query("dome", torch.eye(3))


@pytest.mark.parametrize("text", ["🙂🙂", "окно", "窓", "x" * 2000, "qwertz\0uiop", "a\ud800b", "not", 'a"'])
def test_strange_texts_are_answered(scene, text):
    assert scene.query(text, "0002")[0].relevancy.isfinite().all()


def test_gaussians_score_by_their_own_features_and_unseen_ones_not_at_all(scene):
    words = painted_gaussians()["words"]
    scores = scene.query_gaussians("window")
    assert torch.equal(scores > 0.5, words == 2)
    assert (scores[:-1] > 0).all() and scores[-1] == 0
    assert scene.query_gaussians("wall")[-1] == 0


def test_find_names_the_view_that_shows_most_and_boxes_the_match(scene):
    found = scene.find("dome; window")
    assert [f.viewpoints[0].name for f in found] == ["right/0002.jpg", "left/0001.jpg"]
    assert all(v.rank >= w.rank for v, w in zip(found[0].viewpoints, found[0].viewpoints[1:], strict=False))
    pixel = DISTANCE / 96
    for box, (left, right, bottom, top) in ((found[0].box, DOME), (found[1].box, WINDOWS[1])):
        if box.center[0] < -1.3:  # which of the two equal windows wins is open
            left, right, bottom, top = WINDOWS[0]
        expected = torch.tensor([left, bottom, 0.0, right, top, 0.0])
        assert (torch.tensor([*box.low, *box.high]) - expected).abs().max() < 3 * pixel
    assert found[0].box.share == 1.0
    assert 0.35 < found[1].box.share < 0.65


def test_no_match_has_no_viewpoint_and_no_box(scene):
    found = scene.find("palm tree")[0]
    assert found.viewpoints == [] and found.box is None


def test_the_cache_is_read_back_and_forgotten_with_the_checkpoint(tmp_path):
    expected = painted_scene(tmp_path).find("dome")[0]
    stamps = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert set(stamps) == {"lang3dxl_visible.safetensors"}

    def forbidden(*_):
        raise AssertionError("looked again, though it is kept")

    assert painted_scene(tmp_path, fill=forbidden).find("dome")[0].box == expected.box
    changed = painted_gaussians()
    changed["means"] = changed["means"] + 0.01
    painted_scene(tmp_path, state=changed).find("dome")
    assert all(path.stat().st_mtime_ns > stamps[path.name] for path in tmp_path.iterdir())


@pytest.mark.parametrize("damage", [b"", b"no tensors", None])
def test_a_damaged_cache_is_made_anew(tmp_path, damage):
    painted_scene(tmp_path).find("dome")
    for path in tmp_path.iterdir():
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2] if damage is None else damage)
    assert painted_scene(tmp_path).find("dome")[0].box is not None


def test_views_are_evenly_spread_when_there_are_more_than_asked():
    scene = painted_scene(config=QueryConfig(views=2, view_side=24))
    assert list(scene.visible) == ["left/0001.jpg", "right/0002.jpg"]
    assert scene.visible["left/0001.jpg"].camera.width == 24


def test_what_a_view_shows_fills_it(scene):
    """A wall that fills a view fills all of its pixels."""
    camera = scene.camera("left/0001.jpg")
    assert fill(camera, torch.ones(96, 96)).sum() == pytest.approx(
        float(render(camera, torch.zeros(5185, 1)).alpha.sum()), rel=1e-4
    )


def test_the_painted_scene_is_as_documented():
    assert word_at(torch.tensor([[1.5, 1.5], [-0.8, -0.8], [0.0, 0.0]])).tolist() == [1, 2, 0]


def test_nothing_is_found_outside_a_photos_mask(tmp_path):
    mask = torch.zeros(24, 24, dtype=torch.uint8)  # masks have any size
    mask[:, 12:] = 255
    Image.fromarray(mask.numpy()).save(tmp_path / "mask.png")
    scene, free = painted_scene(), painted_scene()
    masked = replace(scene.file.photo("0003"), mask=str(tmp_path / "mask.png"))
    scene.file.photos[scene.file.photos.index(free.file.photo("0003"))] = masked
    whole = free.query("window", "0003")[0]
    cut = scene.query("window", "0003")[0]
    assert whole.mask[:, :48].any() and not whole.mask[:, 48:].any()  # both windows are on the left
    assert not cut.mask.any()
    assert scene.query("dome", "0003")[0].mask.any()
    assert "all/0003.jpg" in [v.name for v in free.find("window")[0].viewpoints]
    assert "all/0003.jpg" not in [v.name for v in scene.find("window")[0].viewpoints]
    # A free camera has no mask, nor has a photo whose mask is gone.
    assert scene.query("window", masked.camera)[0].mask.any()
    (tmp_path / "mask.png").unlink()
    assert torch.equal(scene.query("window", "0003")[0].mask, whole.mask)


def test_a_prompted_foreground_leaves_only_what_it_finds(scene):
    only = painted_scene(config=QueryConfig(foreground="dome"))
    assert not only.query("window", "0003")[0].mask.any() and only.find("window")[0].box is None
    assert torch.equal(only.query("dome", "0003")[0].mask, scene.query("dome", "0003")[0].mask)
    assert only.find("dome")[0].box == scene.find("dome")[0].box
