"""Questions about things: read, answered, refused, and doubted."""

from dataclasses import replace

import numpy as np
import pytest
from made_things import SIGHT, thing
from painted_scene import painted_file, painted_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.georeference import Georeference
from lang3dxl_ns.things.find import Things, is_upright
from lang3dxl_ns.things.grammar import (
    Request,
    Sight,
    answer,
    answered,
    assumed,
    facing,
    meant,
    parse,
    sight_of,
    table,
    unsure,
)
from lang3dxl_ns.things.thing import Sighting
from lang3dxl_ns.words.taught_words import Example

ON_TOWER = Request("windows", relation="in", others=(Request("tower"),))


@pytest.mark.parametrize(
    ("text", "request_"),
    [
        ("how many windows are there?", Request("windows", count=True)),
        ("highest tower", Request("tower", superlative="highest")),
        ("the third window from the left", Request("window", nth=3, along="left")),
        ("third window on the left", Request("window", nth=3, along="left")),
        ("windows left of the portal", Request("windows", relation="left", others=(Request("portal"),))),
        (
            "the window between the portals",
            Request("window", relation="between", others=(Request("portals"),)),
        ),
        ("count windows not doors", Request("windows", count=True, without=Request("doors"))),
        ("rose window", Request("rose window")),
        (
            "largest window above the portal",
            Request("window", superlative="largest", relation="above", others=(Request("portal"),)),
        ),
        (
            "how many windows on the left tower",
            Request("windows", True, relation="in", others=(Request("tower", superlative="left"),)),
        ),
        (
            "windows above the second door from the left",
            Request("windows", relation="above", others=(Request("door", nth=2, along="left"),)),
        ),
        ("second highest tower", Request("tower", superlative="highest", nth=2)),
        ("the second-highest tower", Request("tower", superlative="highest", nth=2)),
        ("left-most tower", Request("tower", superlative="left-most")),
        ("first-floor windows", Request("first-floor windows")),
        ("twelfth window from the left", Request("window", nth=12, along="left")),
        ("what is the number of windows", Request("windows", count=True)),
        ("the number of the windows", Request("windows", count=True)),
        (
            "how many of the windows are above the dome",
            Request("windows", True, relation="above", others=(Request("dome"),)),
        ),
        ("3rd window from left", Request("window", nth=3, along="left")),
        ("Could you please tell me how many windows there are…", Request("windows", count=True)),
        ("what is the total number of windows in the scene?", Request("windows", count=True)),
        ("take me to the tallest tower of all", Request("tower", superlative="tallest")),
        ("count all of the windows in total, please!", Request("windows", count=True)),
        ("¿what’s the topmost window？", Request("window", superlative="highest")),
        ("third window from the left side", Request("window", nth=3, along="left")),
        (
            "which windows can you see on the left side of the portal",
            Request("windows", relation="left", others=(Request("portal"),)),
        ),
        ("windows beneath the left-hand tower",
         Request("windows", relation="below", others=(Request("tower", superlative="left"),))),
        ('how many "Statue on the roof"', Request("Statue on the roof", count=True)),
        ("how many “doors and gates” not 'a' door",
         Request("doors and gates", True, without=Request("'a' door"))),
        ("windows that are not on the tower", Request("windows", without=ON_TOWER)),
        ("highest windows above the portal but not on the tower",
         Request("windows", False, "highest", None, None, "above", (Request("portal"),), None, ON_TOWER)),
        ("largest windows above the portal, and on the tower",
         Request("windows", False, "largest", None, None, "above", (Request("portal"),), ON_TOWER)),
        ('"top" windows above the "left gate"',
         Request("top windows", relation="above", others=(Request("left gate"),))),
    ],
)  # fmt: skip
def test_questions_are_read(text, request_):
    assert parse(text) == request_


@pytest.mark.parametrize("typed", ["statue on the roof", "Statue On the Roof", '"statue on the roof"'])
def test_taught_names_and_quotes_hold_a_phrase(typed):
    names, word = ["Statue on the roof", "1"], typed.strip('"')
    assert parse(f"how many {typed}", names) == Request(word, count=True)
    assert parse(f"windows above the second {typed} from the left", names).others[0].word == word
    assert parse(f'"big window" on 1 not {typed}', names).without == Request(word)
    assert parse("statue on the roofs", names).relation == "in"


@pytest.mark.parametrize(
    "text",
    [
        *("third window", "windows from the left", "windows between the a and b and c", ""),
        *("left of the door", "windows on the second tower", "windows on"),
        *("tallest two towers", "top window", "gate 3", "0th window from the left", "doors, towers"),
        *(
            "third window from the left part",
            "windows; doors",
            "left of",
            "windows between the",
            "two windows above the portal",
        ),
        *("second highest tower from the left", "windows on the right", "leftmost window from the right"),
        *("windows of the tower", "tallest tower's windows", "windows among the towers", "oldest tower"),
        *(
            "windows on the left side",
            "windows directly above the dome",
            'how many ""',
            'windows above ""',
            'windows not " "',
            "windows not doors not arches",
            "windows not the",
        ),
    ],
)
def test_what_the_grammar_does_not_know_is_said(text):
    with pytest.raises(UserError):
        parse(text)


def test_advice_is_a_sentence_whatever_was_typed():
    def said(text: str) -> str:
        with pytest.raises(UserError) as told:
            parse(text)
        return str(told.value)

    assert (
        said("windows on the right")
        == "windows on the right: say which one, such as the second from the right"
    )
    assert said("3rd window").endswith("such as the 3rd window from the left")
    assert "can't use from, left" in said("3rd window from the left part")
    assert said('windows near the "left gate"').startswith(
        "windows near the left gate: a question can't use near"
    )


def test_a_misspelled_beginning_is_guessed_and_a_word_is_not():
    assert meant("higest tower") == "highest tower"
    assert meant("thrid window") == "third window"
    for name in ("highest", "red tower", "light tower", "rose window", "windows", "tower"):
        assert meant(name) is None


def test_questions_choose_by_place_and_size_and_mirror_with_the_viewer():
    row = [thing(i, "window", (x, 0, 5)) for i, x in enumerate([3, 0, 9, 6])]
    portal = thing(9, "portal", (4.5, 0, 0), (2, 1, 4))
    found = [Things("window", row), Things("portal", [portal])]
    mirrored = Sight(-SIGHT.right, SIGHT.up, SIGHT.ahead)

    def ids(text: str, sight: Sight = SIGHT) -> list[int]:
        return [one.id for one in answer(parse(text), found, sight)]

    assert ids("second window from the left") == [0]
    assert ids("second window from the right") == ids("second window from the left", mirrored) == [3]
    assert ids("leftmost window") == [1] != ids("leftmost window", mirrored)
    assert ids("window left of the portal") == ids("window right of the portal", mirrored) == [0, 1]
    assert ids("window above the portal") == [0, 1, 2, 3]
    assert ids("window below the portal") == []
    assert ids("portal below the leftmost window") == ids("portal left of the rightmost window") == [9]
    assert ids("portal left of the leftmost window") == []
    assert ids("window left of the right window") == [0, 1, 3]
    assert ids("window not left of the portal") == [2, 3]  # the rest of those that are
    assert ids("leftmost window not left of the portal") == [3]
    assert ids("window above the portal, but not left of the right window") == [2]
    assert ids("window right of the leftmost window and left of the rightmost window") == [0, 3]
    assert ids("window above the portal and left of the portal and not right of the portal") == [0, 1]
    assert ids("window not left of the portal and not left of the right window") == [2]
    assert ids("second highest window") == ids("second largest window") == [1]  # in their order
    with pytest.raises(UserError, match="only 4"):
        ids("fifth window from the left")
    with pytest.raises(UserError, match="only 1"):
        ids("second highest portal")


def test_left_and_right_are_told_among_what_the_view_shows():
    row = [thing(i, "window", (x, 0, 5)) for i, x in enumerate([3, 0, 9, 6])]
    found, near = [Things("window", row)], replace(SIGHT, shown=frozenset({0, 3}))

    def ids(text: str) -> list[int]:
        return [one.id for one in answer(parse(text), found, near)]

    assert ids("leftmost window") == ids("second window from the right") == [0]
    assert ids("rightmost window") == ids("second window from the left") == [3]
    assert ids("window right of the leftmost window") == [2, 3]
    assert ids("highest window") == ids("first window from the top") == [0]  # wherever one stands
    for text in ("third window from the left", "third leftmost window"):
        with pytest.raises(UserError, match="only 2 found in this view"):
            ids(text)
    near = replace(SIGHT, shown=frozenset())
    with pytest.raises(UserError, match="none found in this view"):
        ids("leftmost window")


def seen_from_behind_too():
    """A scene with a further photo that looks the other way: with its first photo, and this one."""
    plain = painted_file()
    first = plain.photos[0]
    turned = [[-row[0], row[1], -row[2], row[3]] for row in first.camera_to_world]
    away = replace(first, name="away.jpg", camera_to_world=turned)
    return painted_scene(file=replace(plain, photos=[*plain.photos, away])), first, away


def test_left_and_right_in_a_photo_are_told_among_what_it_shows():
    scene, first, away = seen_from_behind_too()
    windows = scene.things("windows")[0].things
    assert sight_of(scene, windows, first.name).shown == {one.id for one in windows}
    # Whether it was found in a photo, as in none of those that were held out, makes no difference.
    nowhere = [replace(one, sightings=[]) for one in windows]
    assert sight_of(scene, nowhere, first.name).shown == {one.id for one in windows}
    assert sight_of(scene, windows, away.name).shown == frozenset()
    assert sight_of(scene, windows).shown is None


def test_one_photo_tells_left_and_right_in_a_whole_question():
    """The one that shows most of what is asked for, whatever shows most of what it refers to."""
    scene, first, back = seen_from_behind_too()
    box = (0, 0, 9, 9)
    windows = [
        replace(thing(i, "window", (x, 0, 0)), sightings=[Sighting(first.name, box)])
        for i, x in enumerate((0, 3))
    ]
    doors = [
        replace(thing(i, "door", (x, 0, 0)), sightings=[Sighting(back.name, box)])
        for i, x in ((5, -3), (6, 6))
    ]
    found = [Things("window", windows), Things("door", doors)]
    for text, chosen in (
        ("window left of the rightmost door", [0, 1]),
        ("door left of the rightmost window", [6]),
    ):
        request = parse(text)
        view = facing(scene, request, found, None)
        assert {one.id for one in answer(request, found, view)} == {*chosen}, text
        assert answered(request, found, view).text.endswith(f"as seen from {view.photo}")


def sight_in(*pose) -> Sight:
    """Who looks at the painted wall in a photo with these axes (x, y, backward), where gravity tells up."""
    plain = painted_file()
    x, y, back = np.array(plain.photos[0].camera_to_world).T[:3]
    up = Georeference(1.0, tuple(y.tolist()), tuple(-back), 0.1, 3)
    pose = np.column_stack([*(np.array(axis) @ [x, y, back] for axis in pose), back]).tolist()
    photo = replace(plain.photos[0], name="new.jpg", camera_to_world=pose)
    scene = painted_scene(file=replace(plain, photos=[*plain.photos, photo], georeference=up))
    sight = sight_of(scene, [], photo.name)
    return replace(sight, **{name: [x, y, back] @ getattr(sight, name) for name in ("right", "up", "ahead")})


@pytest.mark.parametrize("tilt", [-20, -1, 0, 1, 20, 89])
def test_a_photo_from_above_has_the_right_of_its_picture(tilt):
    """Whether it looks down a little before or behind the vertical."""
    sin, cos = np.sin(np.radians(tilt)), np.cos(np.radians(tilt))
    sight = sight_in((1, 0, 0), (0, sin, -cos), (0, cos, sin))
    np.testing.assert_allclose(
        [sight.right, sight.up, sight.ahead], [(1, 0, 0), (0, 1, 0), (0, 0, -1)], atol=1e-6
    )


@pytest.mark.parametrize("roll", [90, 150, 180, 270])
def test_a_picture_on_its_side_or_head_has_the_right_of_whoever_took_it(roll):
    sin, cos = np.sin(np.radians(roll)), np.cos(np.radians(roll))
    sight = sight_in((cos, sin, 0), (-sin, cos, 0), (0, 0, 1))
    np.testing.assert_allclose([sight.right, sight.ahead], [(1, 0, 0), (0, 0, -1)], atol=1e-6)


def test_heights_are_doubted_where_cameras_do_not_tell_which_way_is_up():
    scene = painted_scene()
    assert is_upright(scene)
    turned = [
        replace(
            one, name=f"t{one.name}", camera_to_world=[[-x, -y, *rest] for x, y, *rest in one.camera_to_world]
        )
        for one in scene.photos
    ]
    assert not is_upright(painted_scene(file=replace(scene.file, photos=[*scene.photos, *turned])))
    found = [
        Things(word, [thing(i, word, (0, 0, 2 * i), views=9)]) for i, word in enumerate(("window", "dome"))
    ]
    lost = replace(SIGHT, upright=False)
    for text in ("highest window", "window below the dome", "first window from the top", "tallest dome"):
        assert "which way is up" in unsure(parse(text), found, lost)
        assert unsure(parse(text), found, SIGHT) is None
    for text in ("leftmost window", "largest window", "window next to the dome"):
        assert unsure(parse(text), found, lost) is None


def test_a_relation_to_several_things_tells_that_any_counts():
    gates = [thing(i, "gate", (x, 0, 0)) for i, x in enumerate([0, 4, 8])]
    found = [Things("window", [thing(9, "window", (2, 0, 0))]), Things("gate", gates)]

    def told(text: str, some=found) -> str:
        return assumed(parse(text), some, SIGHT)

    assert told("window left of the gate") == "gate: 3 found, any of them counts"
    assert told("window left of the leftmost gate") == told("leftmost window") == ""
    assert told("window between the gates", [found[0], Things("gates", gates)]) != ""
    assert told("window between the gates", [found[0], Things("gates", gates[:2])]) == ""
    with pytest.raises(UserError, match="gates: only one found"):
        answer(parse("window between the gates"), [found[0], Things("gates", gates[:1])], SIGHT)


def test_a_scene_answers_with_text_things_and_caution():
    scene = painted_scene()
    counted = scene.answer("How many windows are there?")
    assert (counted.text, len(counted.things), counted.caution) == ("2, perhaps 1 to 2", 2, None)
    left = scene.answer("leftmost window")
    (found,) = left.things
    assert found.center[0] == min(one.center[0] for one in counted.things)
    assert left.text.startswith(f"1 found: id {found.id} in {found.best_photo}; as seen from ")
    assert (
        scene.answer("highest window").text.endswith(".jpg")
        and "seen" not in scene.answer("highest window").text
    )
    assert str(left) == f"{left.text} ({left.caution})" and "unsure" in left.caution
    assert "flamingo: " in scene.answer("how many flamingo").caution  # the word itself is doubted
    assert "did you mean windows?" in scene.answer("how many windwos").caution
    assert "sizes are not told apart" in scene.answer("how many big windows").caution
    taught = scene.teach("big window", Example("all/0003.jpg", points=((69, 69),)))
    assert "not told apart" not in str(taught.answer("big window"))  # a name, in which big says no size
    with pytest.raises(UserError, match="only 2 found in this view"):
        scene.answer("third window from the left", view=scene.overview.name)
    with pytest.raises(UserError, match=r"absent\.jpg"):
        scene.answer("highest window", view="absent.jpg")


def test_every_phrase_of_the_table_is_reached():
    words = table()
    for phrase in words["relations"]:
        other = "doors and gates" if phrase == "between" else "doors"
        assert parse(f"windows {phrase} {other}").relation == words["relations"][phrase]
    for phrase in words["superlatives"]:
        assert parse(f"{phrase} tower").superlative == phrase


def test_an_answer_has_a_caution_if_doubt_would_change_it():
    windows = [thing(i, "window", (x, 0, 0), (1 + x, 1, 1 + x), views=9) for i, x in enumerate((0, 3, 6))]
    portal = thing(9, "portal", (0, 0, -9), views=9)
    rare, perhaps = thing(5, "window", (9, 0, 0), views=2), thing(6, "window", (-4, 0, 5), views=1)

    def caution(text: str, things, candidates=()) -> str | None:
        found = [Things("window", things, list(candidates)), Things("portal", [portal])]
        return unsure(parse(text), found, SIGHT)

    assert caution("leftmost window", windows) is None
    assert caution("leftmost window", windows, [perhaps]) == "window: 3, perhaps 3 to 4"
    assert caution("rightmost window", windows, [perhaps]) is None
    assert caution("rightmost window", [*windows, rare]) == "window: 4, perhaps 3 to 5"
    assert caution("second window from the left", [*windows, rare]) is None
    assert caution("fourth window from the left", [*windows, rare]) == "window: 4, perhaps 3 to 5"
    assert caution("window above the portal", windows) == "window: 3, perhaps 3 to 4"  # as their count
    assert caution("window above the portal", windows[:2]) is None
    assert caution("window above the portal", windows[:2], [perhaps])
    assert caution("leftmost window above the portal", windows) is None
    assert caution("window below the portal", windows, [perhaps]) is None
    assert caution("largest window", windows) is None
    assert caution("portal below the largest window", windows) is None
    assert caution("portal below the largest window", [*windows, thing(4, "window", (0, 0, 0), (6, 1, 7), 9)])
    assert caution("largest window", [*windows, thing(4, "window", (0, 0, 0), (6, 1, 7), views=9)])
    assert caution("third largest window", [*windows, thing(4, "window", (0, 0, 0), (6, 1, 7), 9)]) is None
    assert "nearly" in caution(
        "second largest window", [*windows, thing(4, "window", (0, 0, 0), (6, 1, 7), 9)]
    )
    assert caution("highest window", [*windows, thing(4, "window", (0, 0, 0), (6, 1, 7), views=9)]) is None
