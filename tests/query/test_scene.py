"""A scene's answers, on one whose answers are known."""

from dataclasses import replace

import pytest
import torch
from painted_scene import CODES, DISTANCE, DOME, WINDOWS, decode, painted_scene, render, word_at
from PIL import Image

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.geometry import camera_to_world
from lang3dxl_ns.query.lookup import LookupConfig
from lang3dxl_ns.query.scene import QueryConfig


@pytest.fixture(scope="module")
def scene():
    return painted_scene()


def painted(view, word: int) -> torch.Tensor:
    """Pixels of a view where a word is painted, by the codes themselves."""
    nearest = torch.cdist(view.codes, CODES).argmin(2)
    return (nearest == word) & (view.alpha > 0)


@pytest.mark.parametrize("exact", [False, True])
def test_words_are_found_where_they_are_painted(scene, exact):
    matches = scene.query(["dome; window"], "all/0003.jpg", exact)
    for match, word in zip(matches, (1, 2), strict=True):
        assert torch.equal(match.mask, painted(match.view, word))
        assert match.relevancy.shape == (96, 96)
        assert match.relevancy.min() >= 0 and match.relevancy.max() <= 1
        column, row = match.peak
        assert match.mask[row, column]
        assert match.score == pytest.approx(float(match.relevancy.max()))


def test_the_table_answers_as_the_exact_path_does(scene):
    assert scene.lookup.table is not None
    fast, exact = (scene.query("dome; window", "held/0004.jpg", e) for e in (False, True))
    for a, b in zip(fast, exact, strict=True):
        torch.testing.assert_close(a.relevancy, b.relevancy, atol=0.03, rtol=0)


def test_nothing_is_found_where_nothing_is_seen(scene):
    match = scene.query("object", "all/0003.jpg")[0]
    empty = match.view.alpha == 0
    assert empty.any()
    assert (match.relevancy[empty] == 0).all() and not match.mask[empty].any()


def test_several_prompts_share_one_rendering(scene):
    calls = []
    counting = painted_scene(render=lambda camera: calls.append(camera) or render(camera))
    counting.lookup  # noqa: B018
    calls.clear()
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


def test_mistakes_are_told(scene):
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


def test_gaussians_score_by_their_own_codes(scene):
    assert scene.query_gaussians("dome").argmax() == 1
    assert torch.equal(scene.query_gaussians("window") > 0.5, torch.tensor([False, False, True, False]))


def test_find_names_the_view_that_shows_most_and_boxes_the_match(scene):
    found = scene.find("dome; window")
    assert [f.viewpoints[0].name for f in found] == ["right/0002.jpg", "left/0001.jpg"]
    assert all(v.rank >= w.rank for v, w in zip(found[0].viewpoints, found[0].viewpoints[1:], strict=False))
    pixel = DISTANCE / 96
    for box, (left, right, bottom, top) in ((found[0].box, DOME), (found[1].box, WINDOWS[1])):
        if box.centre[0] < -1.3:  # which of the two equal windows wins is open
            left, right, bottom, top = WINDOWS[0]
        expected = torch.tensor([left, bottom, 0.0, right, top, 0.0])
        assert (torch.tensor([*box.low, *box.high]) - expected).abs().max() < 3 * pixel
    assert found[0].box.share == 1.0
    assert 0.35 < found[1].box.share < 0.65


def test_what_is_nowhere_has_no_viewpoint_and_no_box(scene):
    found = scene.find("palm tree")[0]
    assert found.viewpoints == [] and found.box is None


def test_the_cache_is_read_back_and_forgotten_with_the_checkpoint(tmp_path):
    expected = painted_scene(tmp_path).query("dome", "0004")[0].relevancy
    stamps = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert set(stamps) == {"lang3dxl_views.safetensors", "lang3dxl_lookup.safetensors"}

    def forbidden(codes):
        raise AssertionError("decoded, though the table is there")

    again = painted_scene(tmp_path, decode=forbidden)
    view = again.small_views[1]
    kept = again.scorer().relevancy(view.codes.float(), again.queries(again.prompts("dome")), view.seen(0.3))
    assert kept.isfinite().all()
    assert torch.equal(painted_scene(tmp_path).query("dome", "0004")[0].relevancy, expected)
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == stamps
    changed = {"means": torch.zeros(4, 3), "codes": CODES + 0.1}
    painted_scene(tmp_path, state=changed).lookup  # noqa: B018
    assert all(path.stat().st_mtime_ns > stamps[path.name] for path in tmp_path.iterdir())


@pytest.mark.parametrize("damage", [b"", b"no tensors", None])
def test_a_damaged_cache_is_made_anew(tmp_path, damage):
    painted_scene(tmp_path).lookup  # noqa: B018
    for path in tmp_path.iterdir():
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2] if damage is None else damage)
    assert painted_scene(tmp_path).lookup.table is not None


def test_a_decoder_that_no_table_follows_is_decoded_exactly(tmp_path):
    def rough(codes):
        return decode(4 * torch.sin(400 * codes))

    config = QueryConfig(lookup=LookupConfig(sizes=(8, 16)))
    scene = painted_scene(tmp_path, config, decode=rough)
    assert scene.lookup.table is None
    assert [check.size for check in scene.lookup.checks] == [8, 16]
    fast, exact = (scene.query("dome", "0002", exact=e)[0].relevancy for e in (False, True))
    assert torch.equal(fast, exact)
    kept = painted_scene(tmp_path, config, decode=rough).lookup
    assert kept.table is None and kept.checks == scene.lookup.checks


def test_views_are_evenly_spread_when_there_are_more_than_asked():
    scene = painted_scene(config=QueryConfig(views=2, view_side=24))
    assert [view.name for view in scene.small_views] == ["left/0001.jpg", "right/0002.jpg"]
    assert scene.small_views[0].codes.shape == (24, 24, 3)


def test_the_painting_is_what_the_tests_take_it_for():
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
