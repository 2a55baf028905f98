"""Queries on a scene with known answers."""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from painted_scene import (
    DISTANCE,
    DOME,
    WINDOWS,
    encode_texts,
    painted_file,
    painted_gaussians,
    painted_scene,
    painted_splats,
    word_at,
)
from PIL import Image
from scipy.ndimage import binary_dilation

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.ask import prompts_of
from lang3dxl_ns.query.match import together
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.rendering import composite, rasterize
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


def wider(mask: torch.Tensor) -> np.ndarray:
    """And the pixels around."""
    return F.max_pool2d(mask[None].float(), 3, 1, 1)[0].bool().numpy()


def test_a_view_matches_where_matching_gaussians_cover_it(scene):
    """Not by its own relevancies, in which a strong Gaussian outweighs many that don't match."""
    question = scene.ask("dome; window")
    view = scene.draw(scene.camera("all/0003.jpg"), question.channels)
    covered = composite(scene.splats, view.camera, question.gaussians.T.float()).permute(2, 0, 1)
    relevancy, masks = question.maps(view)
    assert masks.any() and torch.equal(masks, (covered >= 0.3) & (view.alpha >= 0.3))
    stricter = replace(question, thresholds=(1.0, 1.0))
    assert not stricter.maps(scene.draw(view.camera, stricter.channels))[1].any()
    torch.testing.assert_close(stricter.maps(scene.draw(view.camera, stricter.channels))[0], relevancy)


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


def test_answers_do_not_depend_on_the_size_of_the_picture():
    """Needles far thinner than a pixel in training cover little in large pictures, and nothing is learned of
    what lies between the pixels."""
    splats = painted_splats()
    needles = replace(splats, scales=splats.scales * torch.tensor([0.2, 3.0, 1.0]))
    scene = painted_scene(splats=needles, config=QueryConfig(min_alpha=0))
    small = scene.query("dome", "all/0003.jpg", size=96).relevancy
    for size in (192, 288, 480):
        found = scene.query("dome", "all/0003.jpg", size=size)
        assert found.view.pixels.shape[0] == size
        expected = F.interpolate(torch.from_numpy(small)[None, None], (size, size), mode="bilinear")[0, 0]
        np.testing.assert_allclose(found.relevancy, expected, atol=1e-5)


def test_one_text_has_one_answer_and_several_have_a_list(scene):
    assert scene.query("dome", "0003").prompt.text == "dome"
    assert scene.find("dome").prompt.text == "dome"
    for several in (["dome"], "dome; window", ["dome", "window"], ("dome",)):
        assert isinstance(scene.query(several, "0003"), list) and isinstance(scene.find(several), list)


def test_nothing_is_found_where_nothing_is_seen(scene):
    match = scene.query("object", "all/0003.jpg")
    empty = match.view.alpha == 0
    assert empty.any()
    assert (match.relevancy[empty] == 0).all() and not match.mask[empty].any()


def test_several_prompts_share_one_rendering(scene):
    matches = scene.query(["dome", "window; wall"], "all/0003.jpg")
    assert len(matches) == 3
    assert matches[0].view is matches[2].view


@pytest.mark.parametrize(("size", "passes"), [(48, 1), (96, 1), (192, 2)])
def test_a_view_of_at_most_the_training_size_takes_one_pass(scene, monkeypatch, size, passes):
    drawn = []

    def counted(gaussians, camera, *args, **settings):
        drawn.append(camera.width)
        return rasterize(gaussians, camera, *args, **settings)

    question = scene.ask("dome; window")
    monkeypatch.setattr(sys.modules["lang3dxl_ns.rendering.splats"], "rasterize", counted)
    match, _ = scene.matches(question, "all/0003.jpg", size)
    assert drawn == [size, 96][:passes]
    if passes == 1:
        apart = composite(scene.splats, match.view.camera, question.channels)
        expected = question.maps(replace(match.view.rendering, channels=apart))[0][0]
        np.testing.assert_allclose(match.relevancy, expected, atol=1e-6)


def test_a_negative_takes_its_pixels_away(scene):
    alone, against = scene.query(['dome; dome not "domes"'], "right/0002.jpg")
    assert alone.mask.any() and not against.mask.any()
    argument = scene.query("dome", "right/0002.jpg", negatives=["domes"])
    np.testing.assert_array_equal(argument.relevancy, against.relevancy)


def test_one_picture_shows_one_view(scene):
    here, same, other = (scene.query("dome", photo) for photo in ("0002", "0002", "0003"))
    assert together([here, same]).ndim == 3
    for matches in ([], [here, other]):
        with pytest.raises(UserError, match="prompts of one view"):
            together(matches)


def test_a_vector_is_searched_for_like_its_text(scene):
    vector = encode_texts(["dome"])[0]
    words = scene.query("dome", "right/0002.jpg")
    for same in (vector, vector.numpy(), 5 * vector, 1e30 * vector, 1e-30 * vector, scene.encode("dome")):
        np.testing.assert_allclose(scene.query(same, "right/0002.jpg").relevancy, words.relevancy, atol=1e-5)
    np.testing.assert_allclose(scene.relevancy(vector), scene.relevancy("dome"), atol=1e-5)
    assert (scene.find(vector).gaussians == scene.find("dome").gaussians).all()
    for bad in (np.zeros(16), np.full(16, np.nan), np.ones(3)):
        with pytest.raises(UserError, match="a vector to search for"):
            scene.query(bad, "right/0002.jpg")


def test_masks_show_the_gaussians_that_find_selects(scene):
    for word in ("dome", "window"):
        found = scene.find(word)
        chosen = torch.from_numpy(found.gaussians).float()[:, None]
        selected = scene.draw(scene.camera("all/0003.jpg"), chosen).channels[..., 0].numpy() > 0.5
        mask = scene.query(word, "all/0003.jpg").mask
        for one, other in ((mask, selected), (selected, mask)):  # but for a pixel at the edge
            assert one.any() and not (one & ~binary_dilation(other)).any()
        np.testing.assert_array_equal(found.gaussians, found.relevancy > found.threshold)


def test_a_camera_may_be_named_posed_or_given(scene):
    camera = scene.file.photo("0002").camera
    pose = camera_to_world(camera.view_matrix)
    square = torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]])])
    places = ("right/0002.jpg", "0002", camera, pose, square)
    maps = [scene.query("dome", place).relevancy for place in places]
    assert all(np.array_equal(maps[0], other) for other in maps[1:])


def test_a_field_of_view_shows_as_much_as_it_says(scene):
    wide, narrow = (scene.render("0003", fov=fov).alpha for fov in (100, 20))
    assert wide.mean() < 0.5 and narrow.min() > 0.5  # the wall is six units wide, five away
    with pytest.raises(UserError, match="field of view"):
        scene.render("0003", fov=180)


def test_a_pixel_is_named(scene):
    column, row = scene.query("dome", "right/0002.jpg").peak
    (word, score), *_ = scene.what_is("right/0002.jpg", column, row, words=["wall", "dome", "window"])
    assert word == "dome" and score > 0.9
    assert scene.what_is("0003", 0, 0, size=96, words=["wall"]) == []  # beside the wall
    assert scene.what_is("0003", 48, 48, size=96, words=[]) == []
    assert len(scene.what_is("right/0002.jpg", column, row, most=3)) == 3
    with pytest.raises(UserError, match="outside the view"):
        scene.what_is("0003", 5000, 3)


def test_words_of_a_pixel_have_the_relevancies_of_its_gaussians():
    scene = painted_scene(config=QueryConfig(temperature=1.0))
    dome = scene.ask("dome").gaussians[0].nonzero()[0, 0]
    expected = scene.engine.of_gaussians(scene.text.plain_queries(["dome"]))[0, dome]
    column, row = scene.query("dome", "right/0002.jpg").peak
    ((_, score),) = scene.what_is("right/0002.jpg", column, row, words=["dome"])
    assert scene.engine.temperature != 1 and 0.55 < expected < 0.9
    assert score == pytest.approx(float(expected), abs=1e-3)


def test_nothing_is_named_at_the_sky_and_where_nothing_has_a_meaning(scene):
    place = ("right/0002.jpg", *scene.query("dome", "right/0002.jpg").peak)
    dome, codes = scene.ask("dome").gaussians[0], scene.codes
    sky = F.normalize(encode_texts(["sky"]), dim=1)
    for changed in (sky, torch.full_like(sky, torch.nan)):
        other = painted_scene(codes=torch.where(dome[:, None], changed, codes))
        assert other.what_is(*place) == []
        column, row = other.query("windows", "left/0001.jpg").peak
        assert other.what_is("left/0001.jpg", column, row)[0][0] in ("window", "windows")


def test_features_are_unit_vectors_and_unseen_gaussians_have_none(scene):
    lengths = np.linalg.norm(scene.features.astype(np.float32), axis=1)
    np.testing.assert_allclose(lengths[:-1], 1, atol=1e-2)
    assert lengths[-1] == 0
    assert scene.encode(["dome", "wall"]).shape == (2, scene.features.shape[1])


def test_mistakes_are_reported(scene):
    with pytest.raises(UserError, match=r"no photo 'left/001.jpg'.*left/0001.jpg"):
        scene.query("dome", "left/001.jpg")
    with pytest.raises(UserError, match="empty"):
        scene.query([], "0002")
    with pytest.raises(UserError, match="views are requested"):
        scene.find("dome", most=0)
    with pytest.raises(UserError, match="no look"):
        scene.render("0002", look="0002")


@pytest.mark.parametrize(("clip", "why"), [(None, "only colors"), ("clip", "no words yet")])
def test_a_scene_without_words_can_be_seen_but_not_asked_and_says_why(clip, why):
    """Words of a scene with a CLIP are learned when its training ends."""
    scene = Scene(painted_splats(), replace(painted_file(), clip=clip))
    assert scene.render("0003").pixels.any() and why in repr(scene)
    for ask in (scene.query, scene.find, scene.relevancy, scene.encode):
        with pytest.raises(UserError, match=why):
            ask("dome")


@pytest.mark.parametrize("text", ["🙂🙂", "окно", "窓", "x" * 2000, "qwertz\0uiop", "a\ud800b", "not", 'a"'])
def test_strange_texts_are_answered(scene, text):
    assert np.isfinite(scene.query(text, "0002").relevancy).all()


def test_gaussians_score_by_their_own_features_and_unseen_ones_not_at_all(scene):
    words = painted_gaussians()["words"].numpy()
    scores = scene.relevancy("window")
    np.testing.assert_array_equal(scores > 0.5, words == 2)
    assert (scores[:-1] > 0).all() and scores[-1] == 0
    assert scene.relevancy("wall")[-1] == 0


def test_find_names_the_view_that_shows_most_and_boxes_the_match(scene):
    found = scene.find("dome; window")
    assert [f.views[0].name for f in found] == ["right/0002.jpg", "left/0001.jpg"]
    assert all(v.rank >= w.rank for v, w in zip(found[0].views, found[0].views[1:], strict=False))
    pixel = DISTANCE / 96
    for box, (left, right, bottom, top) in ((found[0].box, DOME), (found[1].box, WINDOWS[1])):
        if box.center[0] < -1.3:  # which of the two equal windows wins is open
            left, right, bottom, top = WINDOWS[0]
        expected = torch.tensor([left, bottom, 0.0, right, top, 0.0])
        assert (torch.tensor([*box.low, *box.high]) - expected).abs().max() < 3 * pixel
    assert found[0].box.share == 1.0
    assert 0.35 < found[1].box.share < 0.65


def test_no_match_has_no_view_and_no_box(scene):
    found = scene.find("palm tree")
    assert found.views == [] and found.box is None and not found.gaussians.any()


def test_the_cache_is_read_back_and_forgotten_with_the_geometry(tmp_path, monkeypatch):
    cache = tmp_path / "visible"
    expected = painted_scene(cache).find("dome")
    stamp = cache.stat().st_mtime_ns
    with monkeypatch.context() as patched:
        patched.setattr(
            "lang3dxl_ns.query.visibility.filled_pixels",
            lambda *_: pytest.fail("measured again, though it is kept"),
        )
        assert painted_scene(cache).find("dome").box == expected.box
    splats = painted_splats()
    painted_scene(cache, splats=replace(splats, means=splats.means + 0.01)).find("dome")
    assert cache.stat().st_mtime_ns > stamp


def test_views_are_evenly_spread_when_there_are_more_than_requested():
    scene = painted_scene(config=QueryConfig(views=2, view_side=24))
    assert list(scene.visible) == ["left/0001.jpg", "right/0002.jpg"]
    assert scene.visible["left/0001.jpg"].camera.width == 24


def test_nothing_is_found_outside_a_photos_mask(tmp_path):
    mask = torch.zeros(24, 24, dtype=torch.uint8)  # masks have any size
    mask[:, 12:] = 255
    Image.fromarray(mask.numpy()).save(tmp_path / "mask.png")
    scene, free = painted_scene(), painted_scene()
    masked = replace(scene.file.photo("0003"), mask=str(tmp_path / "mask.png"))
    scene.file.photos[scene.file.photos.index(free.file.photo("0003"))] = masked
    whole = free.query("window", "0003")
    cut = scene.query("window", "0003")
    assert whole.mask[:, :48].any() and not whole.mask[:, 48:].any()  # both windows are on the left
    assert not cut.mask.any()
    assert scene.query("dome", "0003").mask.any()
    assert "all/0003.jpg" in [v.name for v in free.find("window").views]
    assert "all/0003.jpg" not in [v.name for v in scene.find("window").views]
    # A free camera has no mask, nor has a photo whose mask is gone.
    assert scene.query("window", masked.camera).mask.any()
    (tmp_path / "mask.png").unlink()
    np.testing.assert_array_equal(scene.query("window", "0003").mask, whole.mask)


def test_a_foreground_that_is_not_there_is_told_and_its_negatives_are_checked(scene, capsys):
    scene.ask("dome", foreground="window")
    assert "foreground" not in capsys.readouterr().out
    scene.ask("dome", foreground="saxophone")
    scene.ask("window", foreground="saxophone")
    assert capsys.readouterr().out.count("foreground saxophone: doubtful") == 1
    with pytest.raises(UserError, match="its own negative"):
        scene.ask("dome", foreground='"window" not "window"')


def test_numbers_of_numpy_are_sizes_and_angles(scene):
    view = scene.render(scene.photos[0].name, size=np.int64(24), fov=np.float32(60))
    assert max(view.pixels.shape) == 24


def test_the_home_folder_is_found_for_every_output(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    match = scene.query("dome", scene.photos[0].name)
    outputs = [match.save("~/a.png"), match.save("~/a.npy"), match.view.save("~/b.png")]
    scene.export("~/a.ply", "dome", index="~/c.npy")
    found = {path.name for path in tmp_path.iterdir() if path.name != ".config"}  # libraries make that one
    assert found == {"a.png", "a.npy", "b.png", "a.ply", "c.npy"}
    assert all(path.is_file() for path in outputs)


def test_a_prompted_foreground_leaves_only_what_it_finds(scene):
    only = painted_scene(config=QueryConfig(foreground="dome"))
    assert not only.query("window", "0003").mask.any() and only.find("window").box is None
    np.testing.assert_array_equal(only.query("dome", "0003").mask, scene.query("dome", "0003").mask)
    assert only.find("dome").box == scene.find("dome").box


def test_a_scene_without_training_photos_answers_in_views_that_are_named(scene):
    held_out = [replace(photo, split="eval") for photo in scene.photos]
    other = painted_scene(file=replace(painted_file(), photos=held_out))
    np.testing.assert_array_equal(other.query("dome", "0003").mask, scene.query("dome", "0003").mask)
    assert other.find("dome").views == [] and other.gap == 0
    with pytest.raises(UserError, match="no training photos"):
        other.query("dome")


def test_three_threads_get_the_answers_of_one():
    alone, shared = painted_scene(), painted_scene()
    texts = ["dome", "window", "wall", "object"] * 3
    expected = [(alone.query(t, "0003").relevancy, alone.find(t).box) for t in texts]
    with ThreadPoolExecutor(3) as pool:
        maps = [pool.submit(shared.query, t, "0003") for t in texts]
        finds = [pool.submit(shared.find, t) for t in texts]
        pictures = [pool.submit(shared.render, "0003") for _ in texts]
    whole = alone.render("0003").pixels
    for (relevancy, box), match, found, view in zip(expected, maps, finds, pictures, strict=True):
        np.testing.assert_array_equal(match.result().relevancy, relevancy)
        there = found.result().box
        assert (there is None) == (box is None)
        if box is not None:
            assert (there.low, there.high) == (box.low, box.high)
            assert there.share == pytest.approx(box.share, rel=1e-6)
        np.testing.assert_array_equal(view.result().pixels, whole)


@pytest.mark.parametrize("changed", ["mask", "antialiased"])
def test_the_cache_is_forgotten_with_the_masks_and_the_way_of_drawing(tmp_path, changed):
    def scene():
        file = painted_file()
        photos = [replace(photo, mask=str(tmp_path / "mask.png")) for photo in file.photos]
        thin = replace(painted_splats(), antialiased=antialiased)
        thin = replace(thin, scales=0.2 * thin.scales)
        return painted_scene(tmp_path / "visible", file=replace(file, photos=photos), splats=thin)

    antialiased, mask = False, np.full((96, 96), 255, np.uint8)
    Image.fromarray(mask).save(tmp_path / "mask.png")
    before = float(scene().mass.sum())
    if changed == "mask":
        mask[:, 24:] = 0
        Image.fromarray(mask).save(tmp_path / "mask.png")
    else:
        antialiased = True
    assert float(scene().mass.sum()) < 0.5 * before


def test_an_array_of_texts_is_a_list_of_them():
    scene = painted_scene()
    for texts in (np.array(["dome", "windows"]), np.array(["dome", "windows"], object)):
        assert [p.text for p in prompts_of(scene, texts)] == ["dome", "windows"]
