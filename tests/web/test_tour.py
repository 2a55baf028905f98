"""A tour on the page: kept views with words and captions, in the link, played in order."""

import json

import pytest
from pages import DESK, browser, served, until
from painted_scene import painted_scene
from test_live_page import file, live
from test_visits import visit

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.scene_file import (
    Provenance,
    describe_scene_file,
    keep_words,
    read_scene,
    replace_scene,
)
from lang3dxl_ns.web.teach import PageWords
from lang3dxl_ns.web.write_page import Page, write_page

STOPS = [("the dome & its cross; “high”", "dome"), ("", "windows")]
PLAYED = """async () => {
  const stops = [], seen = (caption) => {
    const words = lang3dxl.prompts.map(({ text }) => text).join();
    const shown = caption.hidden ? "" : caption.textContent;
    if (stops.at(-1)?.[1] !== words) stops.push([shown, words, lang3dxl.view.mover.address]);
    else stops.at(-1)[2] = lang3dxl.view.mover.address;
  };
  const watch = setInterval(() => seen(document.getElementById("caption")), 20);
  lang3dxl.clear();
  await lang3dxl.tour.play(1500);
  clearInterval(watch);
  return stops.filter(([, words]) => words);
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
            page.evaluate(f"lang3dxl.view.mover.address = '{len(stands)},0.2,-4,0,0,0,60'")
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
        played = page.evaluate(PLAYED)
        assert played == [[*stop, stand] for stop, stand in zip(STOPS, stands, strict=True)]
        until(page, "document.getElementById('caption').hidden")
        page.click("[aria-label='Remove stop 1']")
        page.go_back()
        until(page, "document.querySelectorAll('#stops li').length", 2)
        page.click("#play")
        page.keyboard.press("Escape")
        until(page, "document.getElementById('play').textContent", "Play the tour")


HOSTILE = ("stop=%00%ff", "stop=" + "x" * 5000, "stop=stop%3Dview&stop=caption%3D<b>", "stops=1&unit=-1")


@pytest.mark.parametrize("hostile", HOSTILE, ids=range(4))
def test_a_damaged_tour_opens_and_plays(browser, address, hostile):
    with visit(browser, f"{address}#{hostile}", DESK) as page:
        page.evaluate("lang3dxl.tour.play(1)")
        assert not page.evaluate("document.querySelector('#stops b, #caption b')")


def test_a_tour_is_kept_in_the_scenes_file_and_plays_from_there(browser, file, tmp_path):
    with live(file) as server, visit(browser, server.access.address, DESK) as page:
        page.evaluate("document.getElementById('tour').open = true")
        page.evaluate("lang3dxl.ask('dome').then(() => true)")
        with page.expect_response("**/api/tour"):
            page.click("#keep")
        with page.expect_response("**/api/tour"):
            page.keyboard.type("High")
            page.keyboard.press("Tab")
    tour = describe_scene_file(file)["provenance"].tour
    assert tour.count("stop=") == 1 and "caption%3DHigh" in tour and "dome" in tour
    keep_words(file, {})  # what teaches a word keeps the tour
    replaced, _ = replace_scene(file, read_scene(file, "cpu"), Provenance())
    told = describe_scene_file(file)["provenance"]
    assert told.tour == tour
    write_page(Page(replaced, provenance=told), tmp_path / "page")
    with served(tmp_path / "page") as address, visit(browser, f"{address}#play=1", DESK) as page:
        page.wait_for_function("document.getElementById('caption').textContent === 'High'")
        page.wait_for_function("lang3dxl.prompts.some(({ text }) => text === 'dome')")


@pytest.mark.parametrize("content", ["[]", "{}", '{"tour": 3}', "null"])
def test_what_is_no_tour_is_not_kept(content):
    with pytest.raises(UserError, match="no tour"):
        PageWords().keep_tour(json.loads(content))
