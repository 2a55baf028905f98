"""A tour on the page: kept views with words and captions, in the link, played in order."""

import pytest
from pages import DESK, browser, served, until
from painted_scene import painted_scene
from test_visits import visit

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
