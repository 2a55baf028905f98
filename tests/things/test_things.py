"""Laws of things: pieces, joining, boxes, outlines and files, on scenes that are drawn by hand."""

import csv
import json
from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_things import thing
from painted_scene import WINDOWS, encode_texts, painted_file, painted_scene

from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.query.trust import FAR
from lang3dxl_ns.query.vocabulary import singular
from lang3dxl_ns.rendering import Camera, Rendering, Splats
from lang3dxl_ns.scene.camera import in_camera_frame
from lang3dxl_ns.scene.georeference import Georeference
from lang3dxl_ns.things.find import PRESENT, Things, axes_of, heights_of, things_of, up_of
from lang3dxl_ns.things.grammar import sight_of
from lang3dxl_ns.things.join import OFTEN, Joined, grown, join, parted, placed, without_crumbs
from lang3dxl_ns.things.outlines import outlined
from lang3dxl_ns.things.pieces import Piece, Shown, pieces_of, split
from lang3dxl_ns.things.thing import upright_box
from lang3dxl_ns.things.write import coco, write_catalog
from lang3dxl_ns.words.taught_words import Example, mask_of


def bumps(*columns: int) -> np.ndarray:
    """Heat map of bumps, 9 pixels apart or more, whose skirts join."""
    y, x = np.mgrid[:20, :60]
    return np.maximum.reduce([np.exp(-((x - c) ** 2 + (y - 10) ** 2) / 18.0) for c in columns])


def piece(photo: str, rows, resolution: float, cut: bool = False) -> Piece:
    return Piece(photo, np.array(rows), resolution, len(rows), (0, 0, 9, 9), cut)


def joined(pieces, places=range(300), shown=None) -> list[Joined]:
    """Join pieces of Gaussians of equal weight at these places along x. `shown`: by photo, if more than what
    its pieces hold."""
    points, weight = np.outer(places, (1.0, 0, 0)), np.ones(len(places))
    held = {
        one.photo: np.unique([i for p in pieces if p.photo == one.photo for i in p.rows]) for one in pieces
    }
    boxed = lambda one: upright_box(points[one.rows], weight[one.rows], np.eye(3))  # noqa: E731
    return join(pieces, weight, boxed, held | (shown or {}))


def test_a_region_splits_where_it_falls_apart_and_only_there():
    heat = bumps(12, 22, 45)
    labels, count = split(heat)
    assert count == 3
    assert len({labels[10, 12], labels[10, 22], labels[10, 45], 0}) == 4
    assert split(bumps(12, 13))[1] == 1
    assert split(np.zeros((5, 5)))[1] == 0


def test_hidden_gaussians_belong_to_no_piece():
    heat, depth = bumps(20), np.full((20, 60), 5.0)
    points = np.array([[20, 10, 5.0], [20, 10, 9.0], [50, 10, 5.0]])
    (found,) = pieces_of(Shown("a", heat, depth, depth, np.array([7, 8, 9]), points, 100.0))
    assert found.rows.tolist() == [7]
    assert found.resolution == pytest.approx(20)
    (deep,) = pieces_of(Shown("a", heat, depth, depth + 4, np.array([7, 8, 9]), points, 100.0))
    assert deep.rows.tolist() == [7, 8]  # a pane behind the wall's edge


def test_a_coarse_view_does_not_join_what_a_fine_one_tells_apart():
    fine = [piece(p, rows, 9.0) for p in "ab" for rows in ([0, 1, 2], [3, 4, 5])]
    coarse = [piece(p, range(6), 1.0) for p in "cdefg"]
    found = joined([*coarse, *fine])
    assert sorted(sorted(one.rows.tolist()) for one in found) == [[0, 1, 2], [3, 4, 5]]
    assert [one.views for one in found] == [2, 2]


def test_sides_that_no_photo_shows_apart_are_one_thing():
    sides = [piece(p, rows, 9.0) for pair, rows in (("ab", [0, 1, 2]), ("cd", [3, 4, 5])) for p in pair]
    assert len(joined(sides)) == 2
    (one,) = joined([*sides, piece("e", range(6), 1.0)])
    assert sorted(one.rows.tolist()) == list(range(6))


def test_heat_that_breaks_in_two_in_one_photo_makes_no_two_things():
    halves = [piece("a", range(5), 9.0), piece("a", range(5, 10), 9.0)]
    whole = [piece(p, range(10), 1.0) for p in "bcd"]
    (one,) = joined([*halves, *whole])
    assert sorted(one.rows.tolist()) == list(range(10))
    assert len(joined([*halves, *whole, piece("e", range(5), 9.0), piece("e", range(5, 10), 9.0)])) == 2


def test_photos_agree_as_far_as_both_show_a_thing():
    sides = [piece("a", range(10), 9.0), piece("b", range(5, 15), 8.0)]
    assert [one.views for one in joined(sides)] == [2]
    assert not joined(sides, shown={p: np.arange(15) for p in "ab"})  # where each would show all of it
    assert not joined([sides[0], piece("b", range(8, 18), 8.0)])  # too little in common


@pytest.mark.parametrize("beside", [True, False])
def test_what_stands_beside_is_another_thing_where_a_photo_has_them_in_two_pieces(beside):
    spire, pinnacle, other = range(10), range(10, 15), range(15, 25)
    alone = [piece(p, rows, 9.0) for p, rows in zip("abcghi", (spire, pinnacle, other) * 2, strict=True)]
    both = [piece("d", [*spire, *pinnacle], 1.0), piece("e", [*spire, *pinnacle], 1.0)]
    # This photo has the spire and what is behind it in one piece, and the pinnacle in another.
    apart = [piece("f", [*spire, *other], 1.0), piece("f", pinnacle, 1.0)]
    places = np.r_[0:10, 20:25, 0:10] if beside else np.r_[0:10, 2:7, 0:10]
    assert len(joined([*alone, *both], places)) == 2
    assert len(joined([*alone, *both, *apart], places)) == (2 if beside else 1)


def test_crumbs_between_two_towers_do_not_make_one_of_them():
    left, right, crumb = range(10), range(10, 20), [20, 21]
    alone = [piece(*one) for one in (("a", left, 9.0), ("b", right, 8.0), ("c", crumb, 7.0))]
    both = [
        piece("d", [*left, *crumb], 2.0),
        piece("e", [*left, *crumb], 2.0),
        piece("f", [*right, *crumb], 2.0),
    ]
    found = joined([*alone, *both])
    assert sorted(sorted(one.rows.tolist()) for one in found) == [[*left, *crumb], [*right]]


def test_a_thing_gets_the_gaussians_that_most_of_its_pieces_show():
    shown = [
        piece("a", [0, 1, 2], 9.0),
        *(piece(p, [1, 2, 3], 5.0) for p in "bcd"),
        piece("e", [1, 2, 4], 5.0),
    ]
    beside = [piece("a", [5, 6, 7], 9.0), piece("b", [3, 5, 6, 7], 5.0)]
    found = grown(joined([*shown, *beside]), 300)
    assert [sorted(one.rows.tolist()) for one in found] == [[0, 1, 2, 3], [5, 6, 7]]
    assert grown([], 9) == []


def test_crumbs_go_and_equals_stay():
    sizes = [np.arange(100), np.arange(100, 200), np.arange(200, 202)]
    found = without_crumbs(joined([piece(p, rows, 1.0) for p in "ab" for rows in sizes]))
    assert [len(one.rows) for one in found] == [100, 100]
    assert without_crumbs([]) == []


def test_many_views_tell_that_a_small_thing_is_no_crumb():
    sizes = [np.arange(100), np.arange(100, 102), np.arange(102, 104)]
    shown = [piece(str(v), rows, 1.0) for rows, n in zip(sizes, (2, OFTEN, OFTEN - 1), strict=True)
             for v in range(n)]  # fmt: skip
    found = without_crumbs(joined(shown))
    assert [len(one.rows) for one in found] == [100, 2]
    assert 100 in found[1].rows


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.1, 2.0])
def test_boxes_stand_along_the_walls(angle):
    rng = np.random.default_rng(0)
    scene = painted_scene()
    up = up_of(scene)
    aside = np.cross(up, np.roll(up, 1))
    aside /= np.linalg.norm(aside)
    along = np.cos(angle) * aside + np.sin(angle) * np.cross(up, aside)
    walls = np.stack([along, np.cross(up, along), up])
    # Two walls at a corner, as thick as a tenth of their length.
    flat = rng.uniform(0, 1, (2, 2000, 3)) * [[[10, 1, 9]], [[1, 10, 9]]] + rng.normal(
        scale=0.1, size=(2, 2000, 3)
    )
    points = flat.reshape(-1, 3) @ walls + (5, 6, 7)

    @dataclass
    class Walls:
        file = scene.file
        photos = scene.photos
        splats = SimpleNamespace(means=torch.tensor(points))
        mass = torch.arange(len(points))
        gap = 0.5

    axes = axes_of(Walls())
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-9)
    assert axes[2] == pytest.approx(up)
    assert abs(axes[:2] @ along).max() == pytest.approx(1, abs=2e-3)
    center, _, size = upright_box(flat[0] @ walls, np.ones(2000), walls)
    assert center == pytest.approx(walls.T @ (5, 0.5, 4.5), abs=0.2)
    assert size == pytest.approx([9.4, 0.94, 8.5], abs=0.3)


def test_a_thing_keeps_its_id_in_later_questions_and_under_other_words():
    scene = painted_scene()
    (first,), (again, _) = scene.things("windows"), scene.things(["window", "dome"])
    assert len(first.things) == 2
    assert {one.id for one in first.things} == {one.id for one in again.things}
    (alone,) = painted_scene().things("window")
    assert {one.id for one in alone.things} == {one.id for one in first.things}


def test_what_was_asked_before_changes_no_id(monkeypatch):
    monkeypatch.setattr("lang3dxl_ns.things.find.COLORED", 10**9)
    scene, fresh = painted_scene(), painted_scene()
    asked, wider = scene.ask("window"), scene.ask("window")
    match = scene.splats.means[asked.relevancy[0] > 0.9]
    near = torch.cdist(scene.splats.means, match).min(1).values
    edge = (near > 0) & (near < 0.2)
    asked.__dict__["relevancy"] = torch.where(edge, 0.4, asked.relevancy)
    wider.__dict__["relevancy"] = torch.where(edge, 0.95, wider.relevancy)
    for one in (scene, fresh):
        vars(one)["mass"] = torch.where(edge, 3 * one.mass, one.mass)
    (before,), (after,), (alone,) = (
        things_of(*pair) for pair in ((scene, wider), (scene, asked), (fresh, asked))
    )
    assert [one.id for one in after.things] == [one.id for one in alone.things]
    assert {one.id for one in before.things}.isdisjoint(one.id for one in after.things)
    assert all(edge[one.rows].any() and not edge[one.id] for one in after.things)  # it fits, if less


def test_the_heavier_thing_comes_first():
    scene = painted_scene()
    x, question = scene.splats.means[:, 0], scene.ask("window")
    plain = question.relevancy
    for half, first in ((x > -0.8, 0), (x < -1.8, 1)):  # a half of the right window, or of the left one
        question.__dict__["relevancy"] = torch.where(half, 0.0, plain)
        (found,) = things_of(scene, question)
        assert [one.center[0] < -1.3 for one in found.things] == [first == 0, first == 1]


def test_what_a_word_that_hardly_fits_finds_are_candidates(monkeypatch):
    monkeypatch.setattr("lang3dxl_ns.things.find.PRESENT", 1.1)
    (answer,) = painted_scene().things("windows")
    assert answer.count == "0, perhaps 0 to 2"


@pytest.mark.parametrize("wrong", [float("nan"), 1e30])
def test_gaussians_that_lie_nowhere_change_no_count(wrong, monkeypatch):
    monkeypatch.setattr("lang3dxl_ns.things.find.COLORED", 10)
    scene = painted_scene()
    stray = scene.splats.means.clone()
    stray[-1] = wrong  # a wall's, far from all windows, whose color depends on the direction that it lacks
    colors = torch.nn.functional.pad(scene.splats.harmonics, (0, 0, 0, 3))
    splats = replace(scene.splats, means=stray, harmonics=colors)
    (answer,) = painted_scene(splats=splats).things("windows")
    assert answer.count == scene.things("windows")[0].count


def test_what_fewer_than_two_photos_show_counts_nothing_and_says_so():
    (answer,) = painted_scene(file=replace(painted_file(), photos=painted_file().photos[:1])).things(
        "windows"
    )
    assert not answer.things and "one training photo shows the scene" in answer.caution


def test_a_place_that_fits_less_than_things_do_is_a_candidate_beside_one_that_fits():
    scene = painted_scene()
    right, question = scene.splats.means[:, 0] > -1.3, scene.ask("window")
    plain = question.relevancy / question.relevancy.max()
    for share, counts in ((1.0, (2, 0)), (0.95 * PRESENT, (1, 1))):
        question.__dict__["relevancy"] = torch.where(right, share * plain, plain)
        (found,) = things_of(scene, question)
        assert (len(found.things), len(found.candidates)) == counts


@pytest.mark.parametrize(("text", "count"), [("minaret", 0), ("window", 2), ("rose window", 2)])
def test_what_another_word_explains_better_is_a_candidate_and_its_word_says_so(text, count):
    scene = painted_scene()
    question, windows = scene.ask(text), scene.ask("window")
    question.__dict__["relevancy"] = windows.relevancy  # such as by a synonym
    (found,) = things_of(scene, question)
    assert (len(found.things), len(found.candidates)) == (count, 2 - count)
    assert (found.caution == "what was found fits 'window' better") == (count == 0)


def test_no_other_word_explains_what_was_taught_better():
    scene = painted_scene()
    taught = scene.teach("minarets", Example("all/0003.jpg", points=((20.0, 64.0),)))
    question = taught.ask("minarets")
    question.__dict__["relevancy"] = scene.ask("windows").relevancy
    assert len(things_of(taught, question)[0].things) == 2


def test_a_sample_of_the_gaussians_tells_the_colors_of_a_word(monkeypatch):
    every = painted_scene().things("windows")[0].things
    monkeypatch.setattr("lang3dxl_ns.things.find.SAMPLED", 100)
    some = painted_scene().things("windows")[0].things
    assert [one.id for one in some] == [one.id for one in every]


def test_the_catalog_names_the_nearest_neighbors_and_what_is_in_what(tmp_path):
    scene = painted_scene()
    row = [thing(i, "=window", (x, 0, 5)) for i, x in enumerate([0, 3, 9])]
    everywhere = thing(9, "wall", (4, 0, 5), (20, 1, 10))
    view = sight_of(scene, row)
    write_catalog(scene, [Things("=window", row), Things("wall", [everywhere])], tmp_path)
    table = [line.split(",")[1] for line in (tmp_path / "things.csv").read_text().splitlines()]
    assert table == ["word", "'=window", "'=window", "'=window", "wall"]  # no spreadsheet's formula
    graph = json.loads((tmp_path / "things.json").read_text())["relations"]
    assert [[a, b] for a, name, b in graph if name == "in"] == [[0, 9], [1, 9], [2, 9]]
    side, other = ("left_of", "right_of") if view.right[0] > 0 else ("right_of", "left_of")
    assert [0, side, 1] in graph
    assert [1, other, 0] in graph
    assert [0, side, 2] not in graph  # the one between is nearer
    assert [1, side, 2] in graph


def gaussians(*places, scale: float = 0.12) -> Splats:
    """Round, nearly opaque Gaussians at places [n, 3], for each list of them."""
    means = torch.tensor(np.concatenate(places), dtype=torch.float32)
    count = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Splats(
        means, quats, torch.full((count, 3), scale), torch.full((count,), 0.95), torch.zeros(count, 1, 3)
    )


def grid(center, size) -> np.ndarray:
    """Places .2 apart that fill a box."""
    axes = [np.arange(-s / 2, s / 2 + 0.01, 0.2) for s in size]
    return np.stack(np.meshgrid(*axes), -1).reshape(-1, 3) + center


def test_outlines_are_drawn_around_what_a_view_shows_and_not_around_what_it_hides():
    camera = Camera(torch.eye(4), torch.tensor([[50.0, 0, 50], [0, 50.0, 40], [0, 0, 1]]), 100, 80)
    gray = Rendering(camera, torch.full((80, 100, 3), 0.5), torch.ones(80, 100), torch.full((80, 100), 5.0))
    shown = thing(1, "window", (1, 0, 5), (1.0, 2.0, 0.2))
    behind, around = thing(2, "window", (-2, 0, 7)), thing(3, "window", (0, 0, -5))
    others = [behind, around, thing(4, "window", (9, 0, 5))]
    own = [grid(one.center, one.size) for one in (shown, *others)]
    wall = grid((0, 0, 5), (8, 6, 0))
    wall = wall[(abs(wall - shown.center) > shown.size / 2).any(1)]
    ends = np.cumsum([0, *map(len, own)])
    shown, *others = (
        replace(one, rows=np.arange(a, b))
        for one, (a, b) in zip((shown, *others), pairwise(ends), strict=True)
    )
    splats = gaussians(*own, wall)
    plain = outlined(splats, [], gray)
    assert (plain == 128).all()
    assert (outlined(splats, [Things("window", others)], gray) == plain).all()
    bare = gaussians(*own)  # without the wall, what lies behind it is seen
    assert (outlined(bare, [Things("window", others)], gray) != plain).any()
    drawn = outlined(splats, [Things("window", [shown, *others])], gray)
    rows, columns = (drawn != plain).any(2).nonzero()
    # Its front side is 4.9 away: 10.2 by 20.4 pixels around column 60 and row 40.
    assert [columns.min(), columns.max()] == pytest.approx([55, 65], abs=1.5)
    assert [rows.min(), rows.max()] == pytest.approx([29.8, 50.2], abs=1.5)
    twice = [Things("window", [shown, *others]), Things("opening", [shown])]
    assert (outlined(splats, twice, gray) == drawn).all()  # once, under the first word


def test_labels_of_photos_cover_the_things_in_pixels_of_the_files(tmp_path):
    plain = painted_file()
    photos = [replace(photo, file=(192, 288)) for photo in plain.photos]
    scene = painted_scene(file=replace(plain, photos=photos))
    (found,) = scene.things("windows")
    content = coco(scene, [found])
    assert {(one["width"], one["height"]) for one in content["images"]} == {(192, 288)}
    centers = [one.center[0] for one in found.things]
    for photo, image in zip(photos, content["images"], strict=True):
        labels = {one["thing"]: one for one in content["annotations"] if one["image_id"] == image["id"]}
        lens = photo.camera.intrinsics.numpy()
        for one in found.things:
            left, right, bottom, top = WINDOWS[int(one.center[0] > np.mean(centers))]
            ends = in_camera_frame(photo.camera, torch.tensor([[left, bottom, 0.0], [right, top, 0]])).numpy()
            (x, y), (x2, y2) = np.sort(((ends / ends[:, 2:]) @ lens[:2].T) * (2, 3), axis=0)
            if not (0 < x < x2 < 192 and 0 < y < y2 < 288):
                continue  # cut off
            label = labels[one.id]
            assert label["segmentation"]["size"] == [288, 192]
            mask = mask_of(label["segmentation"]["counts"], (288, 192))
            assert mask.sum() == label["area"]
            rows, columns = mask.nonzero()
            box = [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
            assert label["bbox"] == box == pytest.approx([x, y, x2 - x, y2 - y], abs=4)
    write_catalog(scene, [found], tmp_path)
    numbers = {image["file_name"]: image["id"] for image in content["images"]}
    boxes = {(one["image_id"], one["thing"]): one["bbox"] for one in content["annotations"]}
    for one in json.loads((tmp_path / "things.json").read_text())["things"]:
        for seen in one["photos"]:  # the piece that a photo shows of it
            x, y, wide, high = boxes[numbers[seen["photo"]], one["id"]]
            assert seen["box"] == pytest.approx([x, y, x + wide, y + high], abs=10)
    shown = {image["file_name"] for image in content["images"]}
    assert "held/0004.jpg" in shown and len(content["annotations"]) > 4


@pytest.mark.parametrize("known", [True, False])
def test_the_catalog_has_meters_where_the_scene_has_them(known, tmp_path):
    place = Georeference(2.5, (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), 0.05, 7) if known else None
    scene = painted_scene(file=replace(painted_file(), georeference=place))
    one = thing(3, "window", (0, 0, 0), (1, 2, 4))
    write_catalog(scene, [Things("window", [one], [])], tmp_path)
    catalog = json.loads((tmp_path / "things.json").read_text())
    assert catalog["things"][0]["number"] == 1
    assert catalog["things"][0]["meters"] == ([2.5, 5.0, 10.0] if known else None)
    assert (catalog["unit"] or {}).get("meters") == (2.5 if known else None)
    ground, top = catalog["heights"]
    above = (np.dot(catalog["up"], one.center) - ground) * (2.5 if known else 1 / (top - ground))
    assert catalog["things"][0]["above_ground"] == pytest.approx(above, abs=1e-3)
    with (tmp_path / "things.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert [row["height"], row["height_m"]] == ["4.0", "10.0" if known else ""]


def test_strays_do_not_move_the_ground():
    scene = painted_scene()
    ground, top = heights_of(scene)
    heights = scene.splats.means.double().numpy() @ up_of(scene)
    assert ground == pytest.approx(heights.min(), abs=0.1) and top == pytest.approx(heights.max(), abs=0.1)
    means = scene.splats.means.clone()
    means[:100] *= 100
    moved = painted_scene(splats=replace(scene.splats, means=means))
    vars(moved)["mass"] = scene.mass  # photos show them
    np.testing.assert_allclose(heights_of(moved), (ground, top), atol=0.02 * (top - ground))


@pytest.mark.parametrize(
    ("found", "more", "said"), [(2, 0, "2"), (5, 0, "5, perhaps 5 to 7"), (5, 4, "5, perhaps 5 to 9")]
)
def test_a_count_allows_for_things_that_no_photo_shows_well(found, more, said):
    each = [thing(i, "window", (i, 0, 0), views=9) for i in range(found + more)]
    assert Things("window", each[:found], each[found:]).count == said


def test_what_an_empty_strip_separates_is_a_thing_of_its_own_unless_it_is_wide():
    def parts(*ends: tuple[float, float]) -> list[list[int]]:
        """Of a thing that reaches from each of these ends to the other along the first axis."""
        level = np.array([(place, 0.0) for low, high in ends for place in np.linspace(low, high, 10)])
        rows = np.arange(len(level))
        piece = Piece("0", rows, 1.0, 9, (0, 0, 1, 1), False)
        found = parted([Joined(rows, 1.0, [piece])], level, np.ones(len(level)), 1.0)
        return sorted([*dict.fromkeys((one.rows // 10).tolist())] for one in found)

    assert parts((0, 0.5), (2, 2.5)) == [[0], [1]]
    assert parts((0, 0.5), (1.4, 1.9)) == [[0, 1]]  # near
    assert parts((0, 3), (5, 5.5)) == [[0], [1]]
    assert parts((0, 3), (5, 8)) == [[0, 1]]  # sides of a dome


def test_things_are_one_where_their_boxes_overlap_or_one_stands_on_the_other():
    def joined(*boxes, others: float = 1.0):
        """others: weight of all but the first."""
        parts = [
            Joined(np.array([i]), others if i else 1.0, [piece("a", [i], 1.0)]) for i in range(len(boxes))
        ]
        placed_at = [(np.array((x, y, z)), np.eye(3), np.array(size, float)) for x, y, z, size in boxes]
        return sorted(sorted(one.rows.tolist()) for one in placed(parts, placed_at))

    shaft, tip, far = (0, 0, 0, (1, 1, 9)), (0.5, 0, 7, (1, 1, 2)), (0, 0, 40, (1, 1, 2))
    assert joined(shaft, tip, (9, 0, 7, (1, 1, 2)), far) == [[0, 1], [2], [3]]
    places = (0, 0), (0.4, 3), (0, -3), (0.6, 3), (0, 5)
    trunk, tip, foot, beside, far = ((x, 0, z, (1, 1, 2)) for x, z in places)
    assert joined(trunk, tip, foot, far, others=0.09) == [[0, 1, 2], [3]]
    assert joined(trunk, beside, others=0.09) == [[0], [1]]
    assert joined(trunk, tip, others=0.11) == [[0], [1]]
    assert joined((0, 0, 0, (1, 0.2, 2)), (0, 0, 3, (1, 0.2, 2))) == [[0], [1]]  # windows in tiers
    dome, side, lantern = (0, 0, 0, (4, 3, 2)), (1, 1, 0, (3, 4, 2)), (0.5, 0.5, 2, (1, 1, 1))
    assert joined(dome, side) == joined(dome, lantern) == [[0, 1]]
    assert joined(dome, (1.9, 1.9, 0, (0.5, 0.5, 2))) == [[0], [1]]  # a pinnacle that the box's corner holds
    assert joined(dome, (1.5, 0, 2, (1, 1, 1))) == joined(dome, (0, 0, -2, (1, 1, 1))) == [[0], [1]]
    assert joined(dome, (0, 0, 5, (1, 1, 1))) == joined(dome, (0, 0, 2.5, (3, 3, 2))) == [[0], [1]]
    assert joined((0, 0, 0, (4, 1, 2)), (0, 0, 2, (1, 1, 1))) == [[0], [1]]  # above a wide window
    assert joined() == []


def test_counts_are_doubtful_where_the_answer_or_the_scene_is():
    scene = painted_scene()

    def caution(foreignness: float, text: str = "windows") -> str | None:
        strange = replace(scene)
        strange.__dict__.update(foreignness=foreignness)
        return strange.things(text)[0].caution

    assert caution(1.0) is None
    assert "as far from what its CLIP was trained on" in caution(FAR)
    assert caution(1.0, "nothing of the kind") is not None


def test_a_word_finds_the_same_things_in_singular_and_plural():
    """Although CLIP takes the plural for something else."""
    scene = painted_scene(
        encode_texts=lambda texts: encode_texts(["sky" if t == "windows" else t for t in texts])
    )
    one, many, both = scene.things(["window", "windows", Prompt("how many windows")])
    assert one.things and [thing.id for thing in one.things] == [thing.id for thing in many.things]
    assert (many.word, many.count, both.count) == ("windows", one.count, one.count)
    assert [singular(text) for text in ("arches", "belfries", "rose windows", "glass", "gargoyls")] == [
        "arch", "belfry", "rose window", "glass", "gargoyls"
    ]  # fmt: skip


def test_negatives_and_the_foreground_count_in_the_singular_too():
    scene, wall = painted_scene(), Prompt("windows", negatives=("window",))
    assert not scene.things([wall])[0].things
    assert not things_of(scene, scene.ask("windows", foreground="sky"))[0].things
