"""Words taught by example, on a scene with known answers."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from painted_scene import Painted, painted_codes, painted_gaussians, painted_scene, painted_splats

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.scene_file import read_scene, write_scene
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.words import learn_word
from lang3dxl_ns.words.learn_word import Weights, _logistic, _Photo
from lang3dxl_ns.words.taught_words import Example, load_words, save_words

ALL = "all/0003.jpg"


def pixel(scene: Scene, photo: str, x: float, y: float) -> tuple[float, float]:
    """Where a photo's file shows a point of the wall."""
    camera = scene.file.photo(photo).full_camera
    seen = camera.view_matrix @ torch.tensor([x, y, 0.0, 1.0])
    spot = camera.intrinsics @ seen[:3]
    return float(spot[0] / spot[2]) - 0.5, float(spot[1] / spot[2]) - 0.5


def box(scene: Scene, photo: str, left: float, right: float, bottom: float, top: float):
    first, second = pixel(scene, photo, left, bottom), pixel(scene, photo, right, top)
    return (*np.minimum(first, second).tolist(), *(np.maximum(first, second) + 1).tolist())


def outline(scene: Scene, photo: str, *boxes) -> np.ndarray:
    mask = np.zeros((96, 96), bool)
    for one in boxes:
        left, top, right, bottom = (round(x) for x in box(scene, photo, *one))
        mask[top:bottom, left:right] = True
    return mask


@pytest.fixture(scope="module")
def scene():
    return painted_scene()


DOME_BOX = (1.0, 2.0, 1.0, 2.0)
FIRST_WINDOW = (-2.0, -1.6, -1.0, -0.6)


def painted(word: int) -> torch.Tensor:
    return painted_gaussians()["words"] == word


def test_a_word_that_clip_does_not_know_is_found_after_one_outline(scene):
    example = Example(ALL, outline(scene, ALL, DOME_BOX))
    taught = scene.teach("gizmo", example)
    found = taught.find("gizmo")
    assert (torch.from_numpy(found.gaussians) == painted(1)).float().mean() > 0.995
    assert found.views and found.box is not None and found.threshold == 0.5
    assert not (scene.relevancy("gizmo") > 0.5)[painted(1)].any(), "the text alone finds it"
    match = taught.query("Gizmo", "right/0002.jpg")
    assert match.mask.any() and match.doubt < 0.05


def test_one_click_on_one_window_finds_the_other(scene):
    taught = scene.teach(
        "hatch", Example("left/0001.jpg", points=(pixel(scene, "left/0001.jpg", -1.8, -0.8),))
    )
    found = torch.from_numpy(taught.find("hatch").gaussians)
    assert found[painted(2)].all() and not found[painted(0)].any()  # this photo doesn't show the dome


def test_a_word_is_found_from_behind(scene):
    """What is learned belongs to the Gaussians, whichever side they are seen from."""
    taught = scene.teach("gizmo", Example(ALL, box=box(scene, ALL, *DOME_BOX)))
    turned = torch.diag(torch.tensor([1.0, 1.0, -1.0]))  # mirrored: the cameras look at the wall's back
    mirrored = replace(scene.splats, means=scene.splats.means @ turned)
    behind = painted_scene(splats=mirrored, words=taught.words)
    assert np.allclose(behind.relevancy("gizmo"), taught.relevancy("gizmo"), atol=1e-5)


def test_a_photo_is_not_judged_by_its_own_marks_under_whatever_name(scene):
    first, edge = outline(scene, ALL, DOME_BOX), outline(scene, ALL, (1.0, 2.0, 1.0, 1.5))
    twice = scene.teach("gizmo", [Example("0003", torch.from_numpy(first)), Example(ALL, edge)])
    taught = twice.words["gizmo"]
    assert [example.photo for example in taught.examples] == [ALL, ALL] and list(taught.precision) == [ALL]
    other = "left/0001.jpg"
    examples = [Example(ALL, edge), Example(ALL, first), Example(other, outline(scene, other, FIRST_WINDOW))]
    # By the other mark in it it has 0.88.
    assert scene.teach("gizmo", examples).words["gizmo"].precision[ALL] < 0.8


def test_the_order_of_examples_does_not_matter(scene):
    examples = [
        Example(ALL, outline(scene, ALL, DOME_BOX)),
        Example("right/0002.jpg", points=(pixel(scene, "right/0002.jpg", 1.5, 1.5),)),
        Example("left/0001.jpg", box=box(scene, "left/0001.jpg", *FIRST_WINDOW)),
    ]
    one, other = (scene.teach("thing", order).words["thing"] for order in (examples, examples[::-1]))
    assert torch.allclose(one.vector, other.vector, atol=1e-5)
    assert one.bias == pytest.approx(other.bias, abs=1e-5)
    assert one.precision == pytest.approx(other.precision, abs=1e-5)


def test_teaching_what_the_text_finds_does_not_lose_it(scene):
    taught = scene.teach("dome", Example(ALL, outline(scene, ALL, DOME_BOX)))
    assert (taught.find("dome").gaussians == scene.find("dome").gaussians).mean() > 0.99
    assert taught.words["dome"].text > 0.5


def test_a_point_that_is_not_the_word_takes_it_back(scene):
    """Both dome and window are clicked; then the window is taken back."""
    photo = "left/0001.jpg"
    here, there = pixel(scene, ALL, 1.5, 1.5), pixel(scene, ALL, -1.8, -0.8)
    both = scene.teach("x", Example(ALL, points=(here, there)))
    assert torch.from_numpy(both.find("x").gaussians)[painted(2)].float().mean() > 0.9
    examples = [Example(ALL, points=(here,), not_points=(there,))]
    taken = scene.teach("x", examples)
    found = torch.from_numpy(taken.find("x").gaussians)
    assert found[painted(1)].float().mean() > 0.9 and not found[painted(2)].any()
    assert photo not in taken.words["x"].precision


def test_a_point_that_is_not_the_word_takes_it_back_from_a_photo_of_its_own_too(scene):
    here, there = pixel(scene, ALL, 1.5, 1.5), pixel(scene, ALL, -1.8, -0.8)
    both = Example(ALL, points=(here, there))
    there = pixel(scene, "left/0001.jpg", -1.8, -0.8)
    words = [
        scene.teach("x", some) for some in ([both], [both, Example("left/0001.jpg", not_points=(there,))])
    ]
    before, after = (word.relevancy("x")[painted(2)].mean() for word in words)
    assert after < before - 0.05
    dome = [Example(ALL, points=(here,)), Example("left/0001.jpg", not_points=(there,))]
    found = torch.from_numpy(scene.teach("x", dome).find("x").gaussians)
    assert found[painted(1)].float().mean() > 0.9 and not found[painted(2)].any()


def test_teaching_leaves_the_scene_as_it_was(scene):
    before = scene.relevancy("dome")
    taught = scene.teach("dome", Example(ALL, box=box(scene, ALL, *FIRST_WINDOW)))
    assert not scene.words and np.array_equal(scene.relevancy("dome"), before)
    assert taught.engine is scene.engine
    assert np.array_equal(taught.with_words(()).relevancy("dome"), before)


def test_a_taught_word_survives_its_file_and_serves_another_scene(scene, tmp_path):
    mask = outline(scene, ALL, DOME_BOX)
    taught = scene.teach("gizmo", [Example(ALL, mask, not_points=((3.0, 4.5),))])
    save_words(tmp_path / "w.json", list(taught.words.values()))
    (read,) = load_words(tmp_path / "w.json")
    assert np.array_equal(read.examples[0].mask, mask) and read.examples[0].not_points == ((3.0, 4.5),)
    other = painted_scene().with_words([read])
    assert np.allclose(other.relevancy("gizmo"), taught.relevancy("gizmo"), atol=1e-6)


def test_an_outline_of_a_large_photo_survives_its_files(scene, tmp_path):
    """Masks are kept at a limited size, and read at any."""
    mask = np.kron(outline(scene, ALL, DOME_BOX), np.ones((20, 20), bool))
    taught = scene.teach("gizmo", Example(ALL, mask))
    save_words(tmp_path / "w.json", list(taught.words.values()))
    write_scene(tmp_path / "a.scene", Scene(taught.splats, taught.file, words=taught.words))
    for (word,) in (load_words(tmp_path / "w.json"), read_scene(tmp_path / "a.scene").words.values()):
        assert word.examples[0].mask.shape == (1024, 1024)
        assert word.examples[0].mask.mean() == pytest.approx(mask.mean(), rel=0.02)


def test_codes_decoded_per_pixel_can_be_taught_too(scene):
    decoder = Painted()
    decoder.per_gaussian = False
    pixels = painted_scene(decoder=decoder, codes=torch.nan_to_num(scene.codes))
    taught = pixels.teach("gizmo", Example(ALL, outline(scene, ALL, DOME_BOX)))
    match, truth = taught.query("gizmo", ALL), outline(scene, ALL, DOME_BOX)
    assert (match.mask & truth).sum() / (match.mask | truth).sum() > 0.8


def test_the_next_photo_to_mark_is_an_unmarked_one(scene):
    taught = scene.teach("gizmo", Example(ALL, box=box(scene, ALL, *DOME_BOX)))
    assert taught.unsure("gizmo") in ("left/0001.jpg", "right/0002.jpg")
    with pytest.raises(UserError, match="was not taught"):
        taught.unsure("dome")


EVERYTHING = np.ones((96, 96), bool)


@pytest.mark.parametrize(
    ("example", "message"),
    [
        (lambda: Example(ALL, EVERYTHING), "cover all of"),
        (lambda: Example(ALL, box=(-1e9, -1e9, 1e9, 1e9)), "cover all of"),
        (lambda: Example(ALL, ~EVERYTHING), "is empty"),
        (lambda: Example(ALL), "nothing is marked"),
        (lambda: Example(ALL, not_points=((1, 1),)), "no example"),
        (lambda: Example(ALL, EVERYTHING[:50]), "the whole photo"),
        (lambda: Example(ALL, points=((float("nan"), 1),)), "not a number"),
        (lambda: Example(ALL, box=(1, 2, float("inf"), 4)), "not a number"),
        (lambda: Example(ALL, box=(1, 2, 3)), "four for a box"),
        (lambda: Example(ALL, points=(5, 5)), "two numbers for a point"),
        (lambda: Example(ALL, np.ones((4, 4, 3))), r"not \[h, w\]"),
        (lambda: Example(ALL, points=((96.5, 1),)), "outside"),
        (lambda: Example(ALL, points=((1, 1),), not_points=((1, -1),)), "outside"),
        (lambda: Example(ALL, box=(50, 2, 40, 4)), "marks nothing"),
        (lambda: Example(ALL, box=(97, 2, 99, 4)), "marks nothing"),
        (lambda: Example(ALL, points=((0.5, 0.5),)), "the scene shows nothing"),
        (lambda: Example("nowhere.jpg", points=((1, 1),)), "no photo"),
    ],
)
def test_marks_that_teach_nothing_are_one_sentence(scene, example, message):
    with pytest.raises(UserError, match=message):
        scene.teach("gizmo", example())


def test_a_word_needs_an_example(scene):
    with pytest.raises(UserError, match="no example"):
        scene.teach("gizmo", [])


def test_numbers_of_numpy_are_coordinates(scene):
    points = np.array([[3, 4]], np.int64)
    example = Example(ALL, points=points, box=np.float32([1, 2, 3, 4]))
    assert example.points == ((3.0, 4.0),) and example.box == (1.0, 2.0, 3.0, 4.0)
    json.dumps(example.to_json())


def test_one_marked_pixel_is_a_mark(scene):
    column, row = (round(x) for x in pixel(scene, ALL, 1.5, 1.5))
    mask = np.zeros((96, 96), bool)
    mask[row, column] = True
    assert (
        torch.from_numpy(scene.teach("gizmo", Example(ALL, mask)).relevancy("gizmo"))[painted(1)].min() > 0.2
    )


@pytest.mark.parametrize(
    "content",
    [
        *("", "[]", "{}", '{"version": 1}', '{"version": 1, "words": [{}]}', '{"version": 1, "words": 3}'),
        '{"version": 1, "words": [{"name": " ", "bias": 0, "text": 0, "doubt": 0, "vector": [1], '
        '"precision": {}, "examples": [], "scene": "", "clip": null}]}',
        '{"version": 1, "words": [{"name": "%s", "bias": 0, "text": 0, "doubt": 0, "vector": [1], '
        '"precision": {}, "examples": [], "scene": "", "clip": null}]}' % ("x" * 9999),
    ],
)
def test_damaged_files_are_one_sentence(tmp_path, content):
    (tmp_path / "w.json").write_text(content)
    with pytest.raises(UserError, match="taught words"):
        load_words(tmp_path / "w.json")


def test_the_fit_is_where_its_loss_has_no_slope():
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(200, 5, generator=generator, dtype=torch.float64)
    word, rest = (torch.rand(200, generator=generator, dtype=torch.float64) for _ in range(2))
    word, rest = word * (places[:, 0] > 0) / 60, rest / 100
    word, rest = word / word.sum(), rest / rest.sum()
    slope, bias = _logistic(places, word, rest, 0.01)
    slope.requires_grad_()
    shift = torch.tensor(bias, dtype=torch.float64, requires_grad=True)
    score = places @ slope + shift
    soft = torch.nn.functional.softplus
    loss = 0.5 * (word @ soft(-score) + rest @ soft(score)) + 0.005 * slope.square().sum()
    loss.backward()
    assert slope.grad.abs().max() < 1e-4 and abs(float(shift.grad)) < 1e-4


def test_separation_is_the_chance_to_rank_right():
    score = torch.tensor([1.0, 2.0, 2.0, 3.0], dtype=torch.float64)
    word = torch.tensor([0.0, 1.0, 0.0, 1.0], dtype=torch.float64)
    photo = _Photo("", word, 1 - word, 0.5, 1, True)
    assert photo.separation(score) == pytest.approx((1 + 0.5 + 1 + 1) / 4)
    assert photo.separation(-score) == pytest.approx(1 - 3.5 / 4)


def test_gaussians_that_no_photo_shows_do_not_change_what_a_word_is(scene):
    splats, codes = painted_splats(), painted_codes()
    known = painted_gaussians()["words"] == 1
    known |= torch.arange(len(known)) % 200 == 0
    codes[~known] = torch.nan
    mark = Example(ALL, box=(61, 61, 77, 77))
    few = painted_scene(codes=codes).teach("thing", mark)
    unseen = splats.select(torch.full((100_000,), len(splats) - 1))
    both = {
        name: torch.cat([getattr(splats, name), getattr(unseen, name)])
        for name in ("means", "quats", "scales", "opacities", "harmonics")
    }
    nothing = codes.new_full((len(unseen), codes.shape[1]), torch.nan)
    many = painted_scene(splats=Splats(**both), codes=torch.cat([codes, nothing])).teach("thing", mark)
    assert float(few.relevancy("thing").max()) > 0.8
    torch.testing.assert_close(
        many.relevancy("thing")[: len(splats)], few.relevancy("thing"), atol=0.05, rtol=0
    )
    with pytest.raises(UserError, match="no photo gave a Gaussian"):
        painted_scene(codes=torch.full_like(codes, torch.nan)).teach("thing", mark)


def test_clicks_are_not_lost_among_the_gaussians_of_an_outline(monkeypatch):
    """Of which only some are fitted."""
    monkeypatch.setattr(learn_word, "_ROWS", 100)
    rows, everything = torch.arange(1000), torch.ones(1000)
    outline, click = (rows < 900).float(), ((rows >= 943) & (rows < 957)).float()
    examples = [Example("a", points=((1, 1),)), Example("b", points=((1, 1),))]
    weights = [Weights(word, torch.zeros(1000), everything) for word in (outline, click)]
    sampled, photos = learn_word._sampled(examples, weights)
    assert len(sampled) <= 2 * 100
    clicked = sampled[photos[1].word > 0]
    assert set(clicked.tolist()) == set(rows[click > 0].tolist())
    assert all(float(part.sum()) == pytest.approx(1) for one in photos for part in (one.word, one.rest))


def test_a_selection_may_be_numpys(scene):
    """As `Found.gaussians` is."""
    chosen = painted(1)
    example = Example(ALL, points=(pixel(scene, ALL, 1.5, 1.5),))
    words = [
        scene.teach("gizmo", example, selection=mask).words["gizmo"] for mask in (chosen, chosen.numpy())
    ]
    assert torch.equal(words[0].vector, words[1].vector)
