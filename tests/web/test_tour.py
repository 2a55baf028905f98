"""A tour on the page: kept views with words and captions, in the link, played in order."""

import json
import subprocess
from urllib.parse import urlencode

import numpy as np
import pytest
from pages import DESK, live, served, until, until_told
from painted_scene import painted_scene
from test_live_page import posted
from test_visits import visit

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.scene_file import (
    Provenance,
    describe_scene_file,
    keep_words,
    read_scene,
    replace_scene,
)
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.things.outlines import outlined
from lang3dxl_ns.web.teach import PageWords
from lang3dxl_ns.web.video import tour_shots, write_video
from lang3dxl_ns.web.write_page import Page, write_page

STOPS = [("the dome & its cross; “high”", "dome"), ("", "windows")]
PLAYED = """async () => {
  const stops = [], seen = (caption) => {
    const words = lang3dxl.prompts.map(({ text }) => text).join();
    const shown = caption.hidden ? "" : caption.textContent;
    if (stops.at(-1)?.[1] !== words) stops.push([shown, words, {}]);
    const times = stops.at(-1)[2], { address } = lang3dxl.view.mover;
    times[address] = 1 + (times[address] ?? 0);
  };
  const watch = setInterval(() => seen(document.getElementById("caption")), 20);
  lang3dxl.clear();
  await lang3dxl.tour.play(1500);
  clearInterval(watch);
  const longest = (times) => Object.entries(times).sort(([, a], [, b]) => b - a)[0][0]; // not a flight
  return stops.filter(([, words]) => words).map(([shown, words, times]) => [shown, words, longest(times)]);
}"""


@pytest.fixture
def address(tmp_path):
    write_page(Page(painted_scene()), tmp_path)
    with served(tmp_path) as found:
        yield found


def test_kept_views_travel_in_the_link_and_play_in_order(browser, address):
    stands = []
    with visit(browser, address, DESK) as page:
        page.evaluate("document.getElementById('tour').open = true")
        for caption, word in STOPS:
            page.evaluate(f"lang3dxl.clear(); lang3dxl.ask('{word}').then(() => true)")
            page.evaluate(f"lang3dxl.view.mover.goTo('{len(stands)},0.2,-4,0,0,0,60')")
            stands.append(page.evaluate("lang3dxl.view.mover.address"))
            page.click("#keep")
            page.keyboard.type(caption)
            page.keyboard.press("Tab")
            until(page, "lang3dxl.tour.stops.length", len(stands))
        until(page, "new URLSearchParams(location.hash.slice(1)).getAll('stop').length", len(STOPS))
        link = page.evaluate("location.href")
    assert stands[0] != stands[1]
    with visit(browser, link, DESK) as page:
        until(page, "lang3dxl.prompts.map(({ text }) => text).join()", "windows")
        until(page, "location.href", link)
        page.emulate_media(reduced_motion="no-preference")
        for views in FLIGHTS:  # a film flies the same way
            told = page.evaluate(FLOWN, [*views, 0.24])
            flown = tour_shots(painted_scene(), tour(*({"view": view} for view in views)))[12][0]
            np.testing.assert_allclose(flown.position, told[:3], atol=1e-3)
            ahead = (flown.view_matrix.double().numpy() @ [*told[3:6], 1])[:3]
            np.testing.assert_allclose(ahead[:2] / ahead[2], 0, atol=1e-3)
            assert flown.height / 2 / flown.intrinsics[1, 1] == pytest.approx(np.tan(np.radians(told[6] / 2)))
        page.emulate_media(reduced_motion="reduce")
        played = page.evaluate(PLAYED)
        assert played == [[*stop, stand] for stop, stand in zip(STOPS, stands, strict=True)]
        until(page, "document.getElementById('caption').hidden")
        page.click("[aria-label='Remove stop 1']")
        page.go_back()
        until(page, "document.querySelectorAll('#stops li').length", 2)
        page.click("#play")
        page.keyboard.press("Escape")
        until(page, "document.getElementById('play').textContent", "Play the tour")


FLIGHTS = [
    ("0,0.5,-4,0,0,0,60", "3,1,0.5,0.5,0,0.2,40"),
    ("0,0.5,-4,0,0,0,60", "0,0.5,-4,1,0,1,60"),
    ("0,0.5,-4,0,0,0,50", "0.1,1,9,0,0,0,50"),
]
FLOWN = """([here, there, time]) => {
  const { mover } = lang3dxl.view;
  mover.goTo(here);
  mover.goTo(there, true);
  mover.flight = { from: mover.stand, to: mover.flight.to, start: 0 };
  mover.advance(1200 * time);
  mover.flight = null;
  return mover.address.split(",").map(Number);
}"""
"""Where the page's eye is after a share of the time of a flight."""


def tour(*stops):
    """A tour as the page writes it."""
    return "#" + urlencode([("stop", urlencode(stop)) for stop in stops])


HOSTILE = ("stop=%00%ff", "stop=" + "x" * 5000, "stop=stop%3Dview&stop=caption%3D<b>", "stops=1&unit=-1")


@pytest.mark.parametrize("hostile", HOSTILE, ids=range(4))
def test_a_damaged_tour_opens_and_plays(browser, address, hostile):
    with visit(browser, f"{address}#{hostile}", DESK) as page:
        page.evaluate("lang3dxl.tour.play(1)")
        assert not page.evaluate("document.querySelector('#stops b, #caption b')")


TOUR = "#stop=caption%3DThe%2Bdome%26view%3D0%2C-4%2C0%2C0%2C0%2C0%2C60%26ask%3Ddome"
TOUR += "&stop=view%3D1%2C-3%2C0.5%2C0%2C0%2C0%2C50"
"""Two stops, as the page writes them; the first has a caption and a prompt."""


def test_a_tour_is_kept_in_the_scenes_file_and_plays_from_there(browser, file, tmp_path):
    with live(file) as server, visit(browser, server.access.address, DESK) as page:
        page.evaluate("document.getElementById('tour').open = true")
        page.evaluate("lang3dxl.ask('dome').then(() => true)")
        with page.expect_response("**/api/tour"):
            page.click("#keep")
        with page.expect_response("**/api/tour"):
            page.keyboard.type("High")
            page.keyboard.press("Tab")
        until(page, "location.hash.includes('stop=')", False)  # the file has it
        page.evaluate("location.hash = 'ask=windows'")  # a link without a tour
        until(page, "lang3dxl.prompts.map(({ text }) => text).join()", "windows")
        assert page.evaluate("lang3dxl.tour.stops.length") == 1
        kept = describe_scene_file(file)["provenance"].tour
        other = json.dumps({"tour": TOUR, "before": kept})  # of another tab
        assert posted(server, other, "/api/tour")[0] == 200
        page.click("#keep")
        until_told(page, "#status", "another tab kept another one")
        assert describe_scene_file(file)["provenance"].tour == TOUR
        page.goto(server.access.address)
        page.evaluate("lang3dxl.ready.then(() => true)")
        until(page, "document.querySelectorAll('#stops li').length", 2)
    ((_, prompts, caption, _),) = tour_shots(
        read_scene(file, "cpu"), kept
    )  # Python reads what the page wrote
    assert caption == "High" and [prompt.text for prompt in prompts] == ["dome"]
    keep_words(file, {}, kept)
    keep_words(file, {})  # what teaches a word keeps the tour
    replaced, _ = replace_scene(file, read_scene(file, "cpu"), Provenance())
    told = describe_scene_file(file)["provenance"]
    assert told.tour == kept
    write_page(Page(replaced, provenance=told), tmp_path / "page")
    with served(tmp_path / "page") as address, visit(browser, f"{address}#play=1", DESK) as page:
        until(page, "document.getElementById('caption').textContent === 'High'")
        until(page, "lang3dxl.prompts.some(({ text }) => text === 'dome')")


@pytest.mark.parametrize("content", ["[]", "{}", '{"tour": 3, "before": ""}', '{"tour": ""}', "null"])
def test_what_is_no_tour_is_not_kept(content):
    with pytest.raises(UserError, match="not a tour"):
        PageWords().keep_tour(json.loads(content), "")


def test_a_tour_that_is_kept_already_is_no_other_one():
    assert PageWords().keep_tour({"tour": "#a", "before": ""}, "#a") == ("#a", True)
    assert PageWords().keep_tour({"tour": "#b", "before": ""}, "#a") == ("#a", False)


def test_a_new_tab_opens_with_the_tour_kept_last_which_only_it_replaces(file):
    def keep(tour, before):
        return posted(server, json.dumps({"tour": tour, "before": before}), "/api/tour")[0]

    def opens_with():
        return json.loads(server.answer("/scene.json")[2])["tour"]

    with live(file) as server:
        assert opens_with() == "" and keep(TOUR, "") == 200 and opens_with() == TOUR
        assert keep("#stop=a", "") == keep("#stop=a", "#stop=b") == 400 and opens_with() == TOUR
        keep_words(file, {}, "#stop=c")  # by another server
        assert keep("#stop=a", TOUR) == 400 and opens_with() == "#stop=c"
        assert keep("#stop=a", "#stop=c") == 200 and opens_with() == "#stop=a"
    assert describe_scene_file(file)["provenance"].tour == "#stop=a"


def frames(path, camera):
    """Read the pictures of a video."""
    read = ["ffmpeg", "-loglevel", "error", "-i", str(path), "-pix_fmt", "rgb24", "-f", "rawvideo", "-"]
    done = subprocess.run(read, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, camera.height, camera.width, 3).astype(float)


def test_a_video_may_have_sides_of_any_length(tmp_path):
    scene = painted_scene()
    assert write_video(tmp_path / "odd.mp4", scene, [(*tour_shots(scene, TOUR, (97, 63))[0][:3], 1)]) == 1
    assert (tmp_path / "odd.mp4").stat().st_size > 500


def test_a_video_flies_through_the_tour(tmp_path):
    scene = painted_scene()
    shots = tour_shots(scene, TOUR, (96, 64))
    (first, prompts, caption, still), *_, (last, nothing, no_caption, end) = shots
    assert [prompt.text for prompt in prompts] == ["dome"] and caption == "The dome"
    assert not nothing and not no_caption and still > end  # a caption takes time to read
    np.testing.assert_allclose(first.position, [0, -4, 0], atol=1e-5)
    np.testing.assert_allclose(last.position, [1, -3, 0.5], atol=1e-5)
    turned = last.view_matrix.double().numpy() @ [0, 0, 0, 1]
    assert turned[2] > 0 and np.abs(turned[:2]).max() < 1e-5  # it looks at what the stop turns around
    count = write_video(tmp_path / "a.mkv", scene, [(*shot[:3], 1) for shot in shots[-3:]])
    pictures = frames(tmp_path / "a.mkv", last)
    assert count == len(pictures) == 3
    assert np.abs(pictures[-1] - scene.render(last).pixels).mean() < 8
    assert [path.name for path in tmp_path.iterdir()] == ["a.mkv"]


OPPOSITE = [
    ((0, 0, -5), (0, 0, 5)),
    ((0, 0, -5), (0.5, 0, 5)),
    ((3, 0, 0), (-7, 0, 0)),
    ((0, 0, 2), (2, 0, 0)),
]


@pytest.mark.parametrize(("here", "there"), OPPOSITE)
def test_a_video_flies_around_what_it_looks_at(here, there):
    stops = ({"view": ",".join(map(str, (*place, 0, 0, 0, 50)))} for place in (here, there))
    away = [float(camera.position.norm()) for camera, *_ in tour_shots(painted_scene(), tour(*stops))]
    assert min(away) > 0.999 * min(away[0], away[-1]) and max(away) < 1.001 * max(away[0], away[-1])


def test_a_video_keeps_thresholds_and_width_of_a_stop_and_names_what_it_leaves_out(tmp_path, capsys):
    scene, stop = painted_scene(), {"view": "0,0,-4,0,0,0,60", "shape": "2.4", "ask": '"dome"', "at": "1"}
    left_out = {"like": "gizmo~5.6", "look": "x", "hide": "100"}
    ((camera, prompts, *_),) = tour_shots(scene, tour(stop | left_out), (96, 64))
    assert camera.width / 2 / camera.intrinsics[0, 0] == pytest.approx(2.4 * np.tan(np.radians(30)))
    assert list(prompts.values()) == [1.0]
    told = capsys.readouterr().out
    assert all(name in told for name in ("words marked by example", "lightings", "hidden floaters"))
    shots = [(camera, asked, "", 1) for asked in (prompts, dict.fromkeys(prompts), {})]
    write_video(tmp_path / "a.mkv", scene, shots)
    chosen, own, plain = frames(tmp_path / "a.mkv", camera)
    assert np.abs(chosen - plain).max() < 8 < np.abs(own - plain).max()  # nothing fits fully


def test_a_video_shows_boxes_of_things_in_place_of_heat(tmp_path):
    scene = painted_scene()
    camera, (windows,) = scene.file.photos[0].camera, scene.things(["window"])
    shots = [(camera, prompts, "", 1) for prompts in ({Prompt("window"): None}, {})]
    assert write_video(tmp_path / "a.mkv", scene, shots, things=True) == 2
    boxed, plain = frames(tmp_path / "a.mkv", camera)
    rendered = scene.render(camera)
    meant = outlined(scene.splats, [windows], rendered.rendering)
    boxes = (meant != rendered.pixels).any(2)
    assert boxes.any()
    assert np.abs(boxed - meant).mean() < 8 < np.abs(boxed - rendered.pixels)[boxes].mean()
    assert np.abs(plain - rendered.pixels).mean() < 8


def test_a_video_says_what_it_lacks(tmp_path, monkeypatch):
    scene = painted_scene()
    shots = tour_shots(scene, TOUR.replace("ask%3D", "x%3D"), (96, 64))
    with pytest.raises(UserError, match="choose another name"):
        write_video(tmp_path / "a.nothing", scene, shots[-1:])
    with pytest.raises(UserError, match="no stop of the tour has a word"):
        write_video(tmp_path / "a.mp4", scene, shots[-1:], things=True)
    assert not list(tmp_path.iterdir())
    for bad in ("#stop=view%3D1", "#stop=view%3Da%2Cb", "#stop=", "#stop=view%3D1%2C2%2C3%2C4%2C5%2C6%2C700"):
        with pytest.raises(UserError, match="tour"):
            tour_shots(scene, bad)
    with pytest.raises(UserError, match="no tour"):
        tour_shots(scene, "")
    with pytest.raises(UserError, match="1,001 stops"):
        tour_shots(scene, "&".join(["stop=view%3D1%2C-3%2C0.5%2C0%2C0%2C0%2C50"] * 1001))
    long = "stop=caption%3D" + "x" * 100_000 + "%26view%3D1%2C-3%2C0.5%2C0%2C0%2C0%2C50"
    assert tour_shots(scene, long)[0][3] == 21 * 25  # what the page takes of it
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UserError, match="needs ffmpeg"):
        write_video(tmp_path / "a.mp4", scene, shots[:1])
