"""Things in the page: the same pieces, joins, boxes and questions as Python's, a list, and addresses."""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from pages import DESK, opened, rest, served, until, until_linked
from painted_scene import painted_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.negatives import singulars
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.query.trust import FAR
from lang3dxl_ns.query.vocabulary import common_words, searched, shipped_vocabulary, singular
from lang3dxl_ns.rendering import Camera, Splats, composite
from lang3dxl_ns.scene.camera import in_camera_frame
from lang3dxl_ns.things.find import Things, better_words
from lang3dxl_ns.things.grammar import Sight, answer, assumed, parse, unsure
from lang3dxl_ns.things.join import Joined, grown, join, parted, placed, without_crumbs
from lang3dxl_ns.things.outlines import shown
from lang3dxl_ns.things.pieces import LEVELS, Piece, split
from lang3dxl_ns.things.thing import Thing, upright_box
from lang3dxl_ns.web.pack import camera_json, splat_bytes
from lang3dxl_ns.web.write_page import Page, write_page
from lang3dxl_ns.words.taught_words import Example

QUESTIONS = [
    *("the big door on the left", "third window on the left"),
    *("how many windows are there?", "highest tower", "the third window from the left", "rose window"),
    *("windows left of the portal", "the window between the doors and gates", "count windows not doors"),
    *(
        "how many windows are there on the left tower?",
        "doors below the window left of the largest dome",
        "left of it",
    ),
    *("largest window above the portal", "2nd window from the top", "windows in front of all the towers"),
    *("second window from the right above the portal", "rightmost window on the right of the tower"),
    *("how many windows are on the left tower?", "windows that are above the door", "how tall is the tower"),
    *("Wie viele Fenster gibt es?", "what is this?", "biggest dome?", "windows which are old"),
    *("third window", "windows from the left", "windows between a and b and c", "", "why windows"),
    *(
        "how many windows are near the portal",
        "highest first window",
        "windows above the door below the roof",
    ),
    *("second highest tower", "3rd window from left", "tallest two towers", "top window", "gate 3"),
    *('how many "Statue on the roof"', "windows near “the left gate”", "windows on the right"),
    *("Could you please count all of the windows…", "which windows can you see beneath the dome, please？"),
    *("tallest tower's windows", "windows of the tower", "left of", "windows between the", "oldest tower"),
    *("what’s on the left side of the portal", "dome inside the left-hand tower", "windows in total"),
    *("third window from the left side", "highest tower; doors", "second highest tower from the left"),
    *("how many statue on the roof", "big Statue On The Roof not 1", "one-way signs", "0th door"),
    *("the second-highest window", "left-most tower", "2nd-largest dome", "what is the number of windows"),
    *("the number of windows", "how many of the windows are above the dome", "twelfth window from the left"),
    *("windows not on the tower", "highest window left of the door but not above it", "windows, not a not b"),
    *("largest windows above the portal and on the tower, and left of the dome", "a between b and in c"),
    *("a not left of b and not right of c", "windows and not doors", "windows above the door and not arches"),
    *("how many windows are not above the highest door", "windows, but not doors above the portal"),
    *("windows directly above the dome", 'how many ""', 'windows above ""', 'windows not " "', "tower-left"),
]
"""Questions that the grammar reads, and some that it refuses."""
SIGHT = Sight(np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.array([0, 1.0, 0]))


@pytest.fixture(scope="module")
def page(browser, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    write_page(Page(painted_scene()), folder)
    with served(folder) as address:
        page = opened(browser, address, DESK)
        yield page
        assert page.complaints == []


def module(page, name: str, body: str, given=None):
    """What a function of a module of the page returns."""
    return page.evaluate(f"async (given) => {{ const m = await import('./{name}.js'); {body} }}", given)


@pytest.mark.parametrize("text", QUESTIONS)
def test_a_question_is_read_as_by_python(page, text):
    body = "try { return m.parse(...given); } catch (error) { return error.message; }"
    names = ["Statue on the roof", "1"]
    found = module(page, "grammar", body, [text, names])
    try:
        expected = json.loads(json.dumps(asdict(parse(text, names))))
    except UserError as error:
        expected = str(error)
    assert found == expected


def test_what_only_a_question_has_makes_one_even_if_it_has_no_answer(page):
    ask = "return given.map((text) => m.isQuestion(text, ['Statue on a roof'], ['arches outside a church']));"
    asked = [
        "third window on the left",
        "doors in a wall",
        'how many "statues on a roof"',
        "second highest tower",
    ]
    asked += [
        "windows near the portal",
        "the third window",
        "2nd door",
        "windows of the highest tower",
        "why me",
        "windows above the portal and below the dome",
        "windows not in the tower",
        "oldest tower",
    ]
    assert module(page, "grammar", ask, asked) == [True] * len(asked)
    plain = ["the big door on the left", "red roof", '"statue on a roof"', "windows not doors", "towers"]
    plain += [
        "statue on a roof",
        "two windows",
        "arches outside a church",
        "windows and doors",
        "first",
        "top window",
        "windows on the left and doors",
        "show me the windows, please",
    ]
    assert module(page, "grammar", ask, plain) == [False] * len(plain)


def test_no_known_phrase_is_taken_for_a_question_without_an_answer(page):
    body = "return given.filter((word) => m.isQuestion(word, [], given) && !answered(word));"
    body = (
        f"const answered = (word) => {{ try {{ return m.parse(word); }} catch {{ return null; }} }}; {body}"
    )
    assert module(page, "grammar", body, list(common_words())) == []


SUPERLATIVES = ("", "highest ", "widest ", "leftmost ", "largest ")
RELATIONS = (*("left of", "right of", "above", "below", "next to", "between", "in", "in front of", "behind"),)
ASKED = [f"{first}window {relation} the portal" for relation in RELATIONS for first in SUPERLATIVES]
ASKED += [
    *("second highest window", "third largest window", "second leftmost portal", "second highest portal"),
    *("window between the portal and the tower", "window between the windows", "window above the tower"),
    *("smallest window", "tallest tower", "third window from the left", "second tower from the top"),
    *("ninth window from the right", "how many windows above the tower", "window left of the left tower"),
    *("portal below the second window from the left", "tower above the smallest window on the portal"),
]


def test_questions_choose_the_things_that_python_chooses_and_are_as_unsure(page):
    rng = np.random.default_rng(3)
    found, number = [], 0
    for word, count, perhaps in (("window", 9, 2), ("windows", 9, 2), ("portal", 2, 0), ("tower", 3, 1)):
        things = []
        for _ in range(count + perhaps):
            number += 1
            center, size = rng.uniform(0, 9, 3), rng.uniform(0.5, 3, 3)
            views = int(rng.integers(2, 12))
            things.append(Thing(number, word, 1.0, views, center, np.eye(3), size, np.array([number])))
        found.append(Things(word, things[:count], things[count:]))

    def listed(things: list[Thing]) -> list[dict]:
        numbers = ("center", "axes", "size")
        return [{"id": t.id, "views": t.views} | {name: getattr(t, name).tolist() for name in numbers}
                for t in things]  # fmt: skip

    given = {one.word: {"things": listed(one.things), "candidates": listed(one.candidates)} for one in found}
    view = {name: getattr(SIGHT, name).tolist() for name in ("right", "up", "ahead")}
    body = """const { found, view } = given, tilted = { ...view, upright: false };
      const things = Object.fromEntries(Object.entries(found).map(([word, one]) => [word, one.things]));
      return given.asked.map((text) => {
        const request = m.parse(text), chosen = m.answerTo(request, things, view);
        const doubts = [view, tilted].map((one) => m.unsure(request, found, one));
        return [chosen.map(({ id }) => id), ...doubts, m.assumed(request, things, view)];
      });"""
    answers = module(page, "grammar", body, {"asked": ASKED, "found": given, "view": view})
    tilted = replace(SIGHT, upright=False)
    for text, (chosen, doubt, lost, any_of) in zip(ASKED, answers, strict=True):
        assert chosen == [t.id for t in answer(parse(text), found, SIGHT)], text
        assert doubt == unsure(parse(text), found, SIGHT), text
        assert lost == unsure(parse(text), found, tilted), text
        assert any_of == assumed(parse(text), found, SIGHT), text
    assert sum(len(chosen) for chosen, *_ in answers) > 20
    assert 5 < sum(doubt is None for _, doubt, *_ in answers) < len(ASKED) - 5
    assert 5 < sum(not any_of for *_, any_of in answers) < len(ASKED) - 5
    # Where a view shows a part of the things, left and right are told among these.
    seen = replace(SIGHT, shown=frozenset(t.id for one in found for t in one.things if t.center[0] > 4))
    body = """const { found, asked } = given, view = { ...given.view, shown: new Set(given.shown) };
      const things = Object.fromEntries(Object.entries(found).map(([word, one]) => [word, one.things]));
      return asked.map((text) => {
        try { return m.answerTo(m.parse(text), things, view).map(({ id }) => id); }
        catch (error) { return error.message; }
      });"""
    asked = [
        *ASKED,
        "window between the highest tower",
        "leftmost window",
        "second window from the left",
        "eighth window from the left",
    ]
    given = {"asked": asked, "found": given, "view": view, "shown": [*seen.shown]}
    assert module(page, "grammar", body, given) == [chosen_or_error(text, found, seen) for text in asked]


def chosen_or_error(text: str, found: list[Things], view: Sight) -> list[int] | str:
    try:
        return [thing.id for thing in answer(parse(text), found, view)]
    except UserError as error:
        return str(error)


def numbered(labels) -> list[int]:
    """Labels by the order in which they first occur."""
    order = {0: 0}
    return [order.setdefault(int(label), len(order)) for label in labels]


def test_a_map_falls_into_the_pieces_of_python(page):
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:40, :60]
    bumps = [
        np.exp(-((x - a) ** 2 + (y - b) ** 2) / c)
        for a, b, c in rng.uniform((0, 0, 2), (60, 40, 16), (20, 3))
    ]
    heat = np.maximum.reduce(bumps).astype(np.float32)
    labels, count = split(heat)
    assert count > 4
    body = "return [...m.split(Float32Array.from(given), 60, 40).labels];"
    found = module(page, "pieces", body, heat.ravel().tolist())
    np.testing.assert_array_equal(numbered(found), numbered(labels.ravel()))  # in whatever order


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_view_is_drawn_as_python_renders_it(page, antialiased):
    """Front to back: what hides a hot Gaussian takes its heat away, and what is hidden adds none."""
    random, count = torch.Generator().manual_seed(5), 300

    def between(low: float, high: float, *size: int):
        return low + (high - low) * torch.rand(size, generator=random)

    means, quats = between(-2, 2, count, 3) + torch.tensor([0, 0, 5.0]), between(-1, 1, count, 4)
    scales, opacities = between(-3, -1, count, 3).exp(), between(0.05, 0.99, count)
    heat = (between(0, 1, count) > 0.5).float() * 0.9 + 0.02
    splats = Splats(means, F.normalize(quats), scales, opacities, torch.zeros(count, 1, 3), antialiased)
    camera = Camera(torch.eye(4), torch.tensor([[60.0, 0, 40], [0, 66, 30], [0, 0, 1]]), 80, 60)
    depth = in_camera_frame(camera, means)[:, 2]
    channels = torch.stack([heat, heat * depth, torch.ones(count), depth], 1)
    map, hot, cover, seen = composite(splats, camera, channels).permute(2, 0, 1)
    packed = splat_bytes(splats, torch.zeros(3), torch.zeros(3)).ravel().tolist()
    view = camera_json(camera) | {"rows": list(range(count)), "codes": [0] * count, "sizes": [1]}
    given = {"packed": packed, "heat": heat.tolist(), "view": view, "antialiased": antialiased}
    body = """const { unpackSplats } = await import("./pick.js"), { packed, view, antialiased, heat } = given;
      const scene = { ...unpackSplats(Uint8Array.from(packed).buffer), antialiased };
      m.drawn(view, scene, heat.map((value) => 1 - value)); // of another word: its projection is kept
      const { map, depth, surface } = m.drawn(view, scene, heat);
      return [map, depth, surface].map((one) => [...one]);"""
    drawn = np.array(module(page, "pieces", body, given)).reshape(3, 60, 80)
    where = map.numpy() > LEVELS[0]  # what no piece holds need not be drawn
    assert 0.05 < where.mean() < 0.9
    for found, expected in zip(drawn, (map, hot / map, seen / cover), strict=True):
        assert abs(found - expected.numpy())[where].mean() < 0.02
    assert ((drawn[0] > LEVELS[0]) == where).mean() > 0.97


@pytest.mark.parametrize("seed", range(3))
def test_a_view_shows_the_things_that_it_shows_in_python(page, seed):
    """Round Gaussians in a box, of which things hold the neighbors of some: many hide each other."""
    rng, count = np.random.default_rng(seed), 1500
    means = torch.tensor(rng.uniform((-3, -2, 3), (3, 2, 9), (count, 3)), dtype=torch.float32)
    scales, opacities = torch.full((count, 3), 0.12), torch.full((count,), 0.9)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    splats = Splats(means, quats, scales, opacities, torch.zeros(count, 1, 3))
    camera = Camera(torch.eye(4), torch.tensor([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]]), 80, 60)
    owner = torch.cdist(means, means[:40]).min(1)
    near = np.where(owner.values < 0.7, owner.indices, -1)
    found = [Thing(n, "window", 1.0, 3, np.zeros(3), np.eye(3), np.ones(3), (near == n).nonzero()[0])
             for n in range(40)]  # fmt: skip
    expected = {number - 1 for number, _, _ in shown(splats, camera, found)}
    packed = splat_bytes(splats, torch.zeros(3), torch.zeros(3)).ravel().tolist()
    given = {"packed": packed, "camera": camera_json(camera), "things": [one.rows.tolist() for one in found]}
    body = """const { gaussiansAt, unpackSplats } = await import("./pick.js");
      const { packed, camera, things } = given;
      const scene = unpackSplats(Uint8Array.from(packed).buffer);
      const hitsAt = (view, pixels) => gaussiansAt([scene], view, pixels, false);
      return m.areShown(things, camera, scene.centers, hitsAt, (id) => id);"""
    told = module(page, "things", body, given)
    assert 5 < len(expected) < 35
    assert len(expected ^ {n for n, is_shown in enumerate(told) if is_shown}) <= 2  # bytes round


def test_pieces_join_as_in_python(page):
    rng = np.random.default_rng(1)
    pieces = []
    for view in range(9):
        for start in range(0, 200, 20):
            wide = rng.choice([8, 16, 18, 38])
            rows = np.unique(rng.integers(start, min(start + wide, 200), 30))
            cut = bool(rng.random() < 0.1)
            pieces.append(Piece(str(view), rows, float(rng.random()), len(rows), (0, 0, 1, 1), cut))
    weight, points = rng.random(500), rng.random((500, 3))
    # Two that photos have in one piece, and another in two, are one where one stands over the other.
    for start in range(200, 400, 10):
        spire, pinnacle, other = (range(start + a, start + b) for a, b in ((0, 4), (4, 7), (7, 10)))
        points[pinnacle] += (rng.uniform(0, 3), 0, 0)
        shown = [("0", spire), ("1", pinnacle), ("2", other), ("3", [*spire, *pinnacle])]
        shown += [("4", [*spire, *pinnacle]), ("5", [*spire, *other]), ("5", pinnacle)]
        for photo, rows in shown:
            fine = 9.0 if photo < "3" else 0.5
            pieces.append(Piece(photo, np.array(rows), fine, len(rows), (0, 0, 1, 1), False))

    # Of these, two photos have little in common.
    for start in range(400, 500, 20):
        for photo, first in (("0", start), ("7", start + 7)):
            pieces.append(Piece(photo, np.arange(first, first + 10), 9.0, 9, (0, 0, 1, 1), False))

    def box(one: Joined):
        return upright_box(points[one.rows], weight[one.rows], np.eye(3))

    shown = {}
    for view in map(str, range(9)):
        own = [p.rows for p in pieces if p.photo == view]
        shown[view] = np.unique(np.concatenate([*own, rng.choice(400, rng.choice([40, 350]))]))
    expected = grown(without_crumbs(join(pieces, weight, box, shown)), 500)
    given = [{"view": int(p.photo), "rows": p.rows.tolist(), "resolution": p.resolution, "cut": p.cut}
             for p in pieces]  # fmt: skip
    body = """const edges = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
      const box = ({ rows }) => m.uprightBox(rows, given.points, given.weight, edges);
      const shows = (view, i) => given.shown[view].includes(i);
      return m.grown(m.withoutCrumbs(m.join(given.pieces, given.weight, box, shows)), 500).map(
      ({ rows, votes }) => [rows.toSorted((a, b) => a - b), new Set(votes.map(({ view }) => view)).size]);"""
    told = {"pieces": given, "weight": weight.tolist(), "points": points.ravel().tolist()}
    found = module(page, "things", body, told | {"shown": [rows.tolist() for rows in shown.values()]})
    assert len(found) > 5
    assert sorted(found) == sorted([sorted(one.rows.tolist()), one.views] for one in expected)


def test_parts_that_empty_strips_separate_are_those_of_python(page):
    rng, things = np.random.default_rng(7), []
    places = np.concatenate([rng.normal(size=(20, 2)) * 0.1 + rng.uniform(0, 4, 2) for _ in range(40)])
    places[:20] = rng.uniform(0, 2, (20, 2))  # wide
    for start in range(0, 800, 100):
        rows, votes = np.arange(start, start + 100), []
        for _ in range(6):
            shown = np.sort(rng.choice(rows, 60, replace=False))
            shown = shown[shown < start + 20 * rng.integers(1, 6)]
            votes.append(Piece("0", shown, 1.0, 9, (0, 0, 1, 1), False))
        things.append(Joined(rows, 1.0, votes))
    weight = rng.random(800)
    expected = parted(things, places, weight, 0.6)
    assert len(expected) > len(things)
    given = {"places": places.tolist(), "weight": weight.tolist()}
    given["things"] = [{"rows": one.rows.tolist(), "weight": 1, "votes": [{"rows": p.rows.tolist()} for p in
                       one.votes]} for one in things]  # fmt: skip
    body = """return m.parted(given.things, (i) => given.places[i], given.weight, 0.6).map(
      ({ rows, votes }) => [rows.toSorted((a, b) => a - b), votes.length]);"""
    found = module(page, "things", body, given)
    assert sorted(found) == sorted([sorted(one.rows.tolist()), len(one.votes)] for one in expected)


@pytest.mark.parametrize(
    ("least", "most"),
    [((0.3, 0.3, 0.3), (0.6, 0.6, 4)), ((0.8, 0.8, 0.8), (2, 2, 1)), ((0.2,) * 3, (4, 4, 1))],
)
def test_things_join_with_those_on_or_around_them_as_in_python(page, least, most):
    rng = np.random.default_rng(4)
    count = 40
    boxes = [(rng.uniform(0, 9, 3), np.eye(3), rng.uniform(least, most)) for _ in range(count)]
    weights = rng.choice([1.0, 0.01], count)
    parts = [Joined(np.array([i]), weight, []) for i, weight in enumerate(weights)]
    expected = sorted(sorted(one.rows.tolist()) for one in placed(parts, boxes))
    assert 5 < len(expected) < count
    given = {
        "parts": [{"rows": [i], "weight": w, "votes": []} for i, w in enumerate(weights.tolist())],
        "boxes": [
            dict(zip(("center", "axes", "size"), map(np.ndarray.tolist, box), strict=True)) for box in boxes
        ],
    }
    body = "return m.placed(given.parts, given.boxes).map(({ rows }) => rows.toSorted((a, b) => a - b));"
    assert sorted(module(page, "things", body, given)) == expected


def test_a_plural_is_one_thing_of_pythons(page):
    texts = [
        "windows",
        "Arches",
        "how many belfries",
        "rose windows",
        "glass",
        "window",
        "gargoyls",
        "windows on the left",
        "dark belfries",
        "round oculi",
    ]
    texts += [*common_words(), *(f"{word}s" for word in shipped_vocabulary())]
    body = """const { Vocabulary } = await import("./vocabulary.js"), { words, texts } = given;
      const vocabulary = Object.create(Vocabulary.prototype);
      Object.assign(vocabulary, { words: [...words, "gargoyl"], common: words.length });
      return texts.map((text) => [words[vocabulary.singular(text)] ?? text, vocabulary.commonIn(text)]);"""
    words = shipped_vocabulary()
    forms = [{form for word in searched(text).lower().split() for form in singulars(word)} for text in texts]
    within = [[i for i, word in enumerate(words) if own >= {*word.split()}] for own in forms]
    expected = [[singular(text), common] for text, common in zip(texts, within, strict=True)]
    assert module(page, "answer", body, {"words": words, "texts": texts}) == expected


def test_a_word_that_hardly_fits_names_nothing_as_in_python(page):
    body = """const of = (peak) => Float32Array.from({ length: 1000 }, (_, i) => (i < 5 ? peak : 0.1));
      return given.map((peak) => m.isThere(of(peak), { best: 0.005 }));"""
    assert module(page, "things", body, [LEVELS[0] - 0.01, LEVELS[0] + 0.01]) == [False, True]


def test_words_that_fit_things_better_are_those_of_python(page):
    rng, words = np.random.default_rng(6), shipped_vocabulary()
    prompts = ("minarets", "dark windows", "windows on the left tower", "Kuppel", "cross vault", "the gate")
    texts = {text: torch.tensor(rng.normal(size=8)) for text in (*words, *map(searched, prompts))}
    vectors = {text: F.normalize(vector, dim=0) for text, vector in texts.items()}
    rows, weight = torch.tensor(rng.normal(size=(9, 8))), rng.random(9)
    rows[:3] += 4 * vectors["window"]
    rows[3:6] += 4 * vectors["vault"]
    things = [Joined(np.arange(k, k + 3), 1.0, []) for k in (0, 3, 6)]
    scene = SimpleNamespace(
        device="cpu",
        text=SimpleNamespace(vectors=lambda listed: torch.stack([vectors[text] for text in listed])),
        engine=SimpleNamespace(features=lambda of: F.normalize(rows[of], dim=1), temperature=4.0),
    )
    unit, found = F.normalize(rows, dim=1).tolist(), list[str | None]()
    body = """const { Vocabulary } = await import("./vocabulary.js"), { words, vectors } = given;
      const vocabulary = Object.assign(Object.create(Vocabulary.prototype), { words, common: words.length });
      vocabulary.word = (i) => ({ own: vectors[i] });
      const rows = { width: 8, row: (i) => given.unit[i] };
      const one = new m.Answers(rows, vocabulary, { temperature: 4 });
      return given.weighted.map((some) => one.better(some, given.prompt));"""
    for text in prompts:
        better = better_words(scene, Prompt(text), things, weight)
        prompt = {"name": text, "own": vectors[searched(text)].tolist()}
        given = {"words": words, "vectors": [vectors[word].tolist() for word in words], "unit": unit}
        given |= {"weighted": [[(int(i), weight[i]) for i in one.rows] for one in things], "prompt": prompt}
        expected = [better.get(one) for one in things]
        assert module(page, "answer", body, given) == expected, text
        found += expected
    assert found.count(None) > 2 and len({*found}) > 3


def test_boxes_are_those_of_python(page):
    rng = np.random.default_rng(2)
    for _ in range(3):
        points, weight = rng.normal(size=(300, 3)) * (3, 1, 2), rng.random(300)
        axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        center, _, size = upright_box(points, weight, axes)
        given = {"points": points.ravel().tolist(), "weight": weight.tolist(), "axes": axes.tolist()}
        body = "return m.uprightBox([...given.weight.keys()], given.points, given.weight, given.axes);"
        found = module(page, "things", body, given)
        for name, expected in (("center", center), ("axes", axes), ("size", size)):
            np.testing.assert_allclose(found[name], expected, atol=1e-6)


SHARED = """async ([cores, lost]) => {
  const start = `Object.defineProperty(navigator, "hardwareConcurrency", { value: ${cores} });
    const Own = Worker;
    let helpers = 0;
    self.Worker = class {
      constructor(...given) {
        helpers++;
        if (!${lost}) return new Own(...given);
        setTimeout(() => this.onerror());
      }
      postMessage() {}
    };
    addEventListener("message", ({ data }) => data === "helpers" && postMessage({ output: helpers }));
    await import("${location.origin}/worker.js");
    postMessage({ output: "ready" });`;
  const worker = new Worker(URL.createObjectURL(new Blob([start], { type: "text/javascript" })), { type: "module" });
  const next = () => new Promise((resolve, reject) => {
    worker.onerror = reject;
    worker.onmessage = ({ data }) => (data.error ? reject(data.error) : data.output && resolve(data.output));
  });
  const think = (message) => (worker.postMessage(message), next());
  await next();
  const read = async (name) => (await fetch(name)).arrayBuffer();
  const about = JSON.parse(new TextDecoder().decode(await read("scene.json")));
  about.files = Object.fromEntries(Object.entries(about.files).map(([name, own]) => [name, `${location.origin}/${own}`]));
  await think({ id: 1, job: "load", input: { description: about, splats: await read(about.files["splats.bin"]) } });
  const given = { text: "windows", negatives: [] };
  const { relevancy } = await think({ id: 1, job: "ask", input: given });
  const answers = [];
  for (let n = 0; n < 2; n++) answers.push(await think({ id: 1, job: "things", input: { ...given, relevancy } }));
  const helpers = await new Promise((resolve) => {
    worker.onmessage = ({ data }) => resolve(data.output);
    worker.postMessage("helpers");
  });
  worker.terminate();
  return [helpers, ...answers.map((one) => JSON.stringify(one, (_, value) => (ArrayBuffer.isView(value) ? [...value] : value)))];
}"""  # noqa: E501
"""Things of a word, twice, on so many cores, with helpers that can't start if lost."""


def test_things_are_the_same_however_many_workers_look_for_them(page):
    alone, *answers = page.evaluate(SHARED, [1, False])
    assert alone == 0 and '"things":[{' in answers[0] and answers[0] == answers[1]
    assert page.evaluate(SHARED, [2, False]) == [1, *answers]
    assert page.evaluate(SHARED, [64, False]) == [3, *answers]
    assert page.evaluate(SHARED, [64, True]) == [3, *answers]


def test_a_word_lists_its_things_and_one_can_be_chosen_hidden_and_linked(page):
    page.evaluate("lang3dxl.ask('windows')")
    summary = page.locator("#prompts summary")
    summary.wait_for()
    assert summary.inner_text().startswith("2")
    summary.click()
    until(page, "document.querySelectorAll('#prompts ol button').length", 2)
    until(page, "document.querySelectorAll('#boxes path.thing').length", 2)
    page.evaluate("document.body.dispatchEvent(new KeyboardEvent('keydown', { key: ']', bubbles: true }))")
    page.locator("#prompts ol li:first-child button[aria-pressed=true]").wait_for()
    page.get_by_role("button", name="Overview").click()
    until(page, "document.querySelectorAll('#boxes path.thing').length", 2)
    page.get_by_role("button", name="Hide the rest").click()
    until(page, "lang3dxl.view.only !== null")
    until(page, "document.querySelectorAll('#boxes path.thing').length", 1)
    shown = page.evaluate("lang3dxl.view.only.size")
    assert 0 < shown < page.evaluate("lang3dxl.view.root.count")
    until_linked(page, "thing=")
    until_linked(page, "alone=1")
    address = page.evaluate("location.hash")
    page.locator("body").press("Escape")
    until(page, "lang3dxl.view.only", None)
    page.evaluate("lang3dxl.clear()")
    page.evaluate("(hash) => { location.hash = hash; }", address)
    page.locator("#prompts ol button[aria-pressed=true]").wait_for()
    until(page, "lang3dxl.view.only?.size", shown)
    page.evaluate("lang3dxl.clear()")


def test_questions_typed_into_the_page_are_answered_or_refused(page):
    told = page.evaluate("lang3dxl.ask('how many windows are there?').then(({ told }) => told)")
    assert told.startswith("windows: 2")
    page.evaluate("lang3dxl.clear()")
    page.evaluate("""lang3dxl.ask('"windows" not "window"')""")  # another prompt, which finds nothing
    assert page.evaluate("lang3dxl.ask('how many windows are there?').then(({ told }) => told)") == told
    told = page.evaluate("lang3dxl.ask('how many windows above the dome').then(({ told }) => told)")
    assert told.startswith("windows: 2. Unsure, since windows: ")  # also where all are above it
    told = page.evaluate("lang3dxl.ask('leftmost window').then(({ told }) => told)")
    assert told.startswith("window number ")
    until(page, "document.querySelectorAll('#prompts ol button[aria-pressed=true]').length", 1)
    told = page.evaluate("lang3dxl.ask('How many windows are below the red dome?').then(({ told }) => told)")
    assert "windows" in told and "dome" in told and "color" in told  # which part wasn't used
    page.evaluate("lang3dxl.ask('what is this?')")
    assert page.locator("#here").is_visible() and "middle" in page.locator("#status").inner_text()
    # What the view shows is counted below: the flight to the leftmost window may be anywhere.
    page.evaluate("lang3dxl.view.mover.jump(lang3dxl.view.mover.overviewStand())")
    rest(page)
    for text, told in (
        ("how many windows near the dome", "can't use near"),
        ("windows near the dome", "can't use near"),
        ("third window", "say from which side"),
        ("third window from the left", "only 2 found in this view"),
        ("not doors", "has only negatives"),
    ):
        refused = "(text) => lang3dxl.ask(text).catch((error) => error.message)"
        assert told in page.evaluate(refused, text)
    told = page.evaluate("""lang3dxl.ask('dome above the "windows"').then(({ told }) => told)""")
    assert "windows: 2 found, any of them counts" in told
    page.evaluate("lang3dxl.clear()")
    until(page, "lang3dxl.view.only", None)


def test_counts_in_a_strange_scene_have_a_caution_and_taught_names_are_whole(browser, tmp_path):
    strange = painted_scene()
    strange.__dict__.update(foreignness=FAR)
    mark = Example(strange.photos[0].name, points=((48.0, 48.0),))
    write_page(Page(strange.teach("Big hole in the wall", mark)), tmp_path)
    with served(tmp_path) as address:
        page = opened(browser, address, DESK)
        told = page.evaluate("lang3dxl.ask('how many windows').then(({ told }) => told)")
        taught = page.evaluate("lang3dxl.ask('how many big hole in the wall').then(({ told }) => told)")
    assert told.startswith("windows: 2") and "Not sure" in told
    assert taught.startswith("big hole in the wall: ") and "told apart" not in taught
