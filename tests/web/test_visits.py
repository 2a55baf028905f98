"""Visits in Chromium at two sizes: by keyboard alone, by touch alone, in forced colors, under axe."""

import shutil
import subprocess
import tarfile
from contextlib import contextmanager
from functools import cache

import pytest
from pages import PHONE, prompts_of, served, until
from painted_scene import painted_scene
from PIL import Image

from lang3dxl_ns.web.write_page import Page, write_page

AXE = "axe-core@4.10.3"
SIZES = pytest.mark.parametrize("size", [PHONE, {"width": 1440, "height": 900}], ids=["phone", "desk"])
FOCUSED = """() => {
  const at = document.activeElement, box = at.getBoundingClientRect(), style = getComputedStyle(at);
  const label = at.labels?.[0]?.textContent.trim();
  return { id: at.id, name: at.ariaLabel || at.textContent.trim() || label || at.placeholder,
    seen: box.width > 0 && box.right > 0 && box.bottom > 0 && box.left < innerWidth && box.top < innerHeight,
    outlined: style.outlineStyle !== "none" && parseFloat(style.outlineWidth) > 0,
    body: at === document.body };
}"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The page of the painted wall, with its photos."""
    folder, scene = tmp_path_factory.mktemp("visits"), painted_scene()
    for photo in scene.photos:
        (folder / "photos" / photo.name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(scene.render(photo.full_camera).pixels).save(folder / "photos" / photo.name)
    write_page(Page(scene, photos=folder / "photos"), folder / "page")
    with served(folder / "page") as found:
        yield found


@pytest.fixture(scope="module")
def axe(tmp_path_factory):
    """The script of axe, from npm."""
    folder = tmp_path_factory.mktemp("axe")
    if shutil.which("npm") is None:
        pytest.skip("needs npm, for axe-core")
    done = subprocess.run(["npm", "pack", AXE], cwd=folder, capture_output=True, text=True, timeout=120)
    if done.returncode:
        pytest.skip(f"npm gives no {AXE}: {done.stderr.strip()[-200:]}")
    with tarfile.open(next(folder.glob("*.tgz"))) as packed:
        return packed.extractfile("package/axe.min.js").read().decode()


@cache
def tab(browser, touch: bool):
    """A tab that tests visit one after the other, with a touch screen or without."""
    context = browser.new_context(has_touch=True, is_mobile=True) if touch else browser.contexts[0]
    page = context.new_page()
    page.set_default_timeout(120_000)
    page.complaints = []
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    return page


@contextmanager
def visit(browser, address, size, forced_colors="none"):
    """A page that is ready and has not moved yet, and complains about nothing."""
    page = tab(browser, size is PHONE)
    page.set_viewport_size(size)
    page.emulate_media(reduced_motion="reduce", forced_colors=forced_colors)
    page.complaints.clear()
    page.goto(address)
    page.evaluate("lang3dxl.ready.then(() => true)")
    try:
        yield page
    finally:
        page.goto("about:blank")
    assert page.complaints == []


def tab_to(page, name: str) -> None:
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate(FOCUSED)["name"] == name:
            return
    raise AssertionError(f"the tabulator never reaches {name!r}")


@pytest.mark.slow
@SIZES
def test_every_stop_of_the_tabulator_is_seen_named_and_outlined(browser, address, size):
    with visit(browser, address, size) as page:
        page.evaluate("lang3dxl.ask('dome; windows')")
        page.evaluate("document.getElementById('more').open = true")
        page.locator("#prompts summary", has_text="found").nth(1).wait_for()  # then no card is drawn anew
        stops = []
        while not stops or (len(stops) < 80 and not page.evaluate(FOCUSED)["body"]):
            page.keyboard.press("Tab")
            stops.append(page.evaluate(FOCUSED))
        stops.pop()
        assert len(stops) > 20 and {"frame", "word", "overview"} <= {stop["id"] for stop in stops}
        assert [stop for stop in stops if not (stop["name"] and stop["seen"] and stop["outlined"])] == []


@pytest.mark.slow
@SIZES
def test_a_visit_by_keyboard_alone(browser, address, size):
    with visit(browser, address, size) as page:
        page.keyboard.press("/")
        page.keyboard.type("dome; windows")
        page.keyboard.press("Enter")
        until(page, "lang3dxl.prompts.length", 2)
        page.keyboard.press("Escape")  # out of the search box
        level = page.evaluate("lang3dxl.prompts[0].threshold")
        tab_to(page, "Threshold of dome")
        page.keyboard.press("ArrowRight")
        until(page, f"lang3dxl.prompts[0].threshold > {level}")
        page.keyboard.press("Control+z")
        until(page, f"Math.abs(lang3dxl.prompts[0].threshold - {level}) < 1e-6")
        tab_to(page, "Remove windows")
        page.keyboard.press("Enter")
        until(page, "lang3dxl.prompts.length", 1)
        page.keyboard.press(".")
        until(page, "document.getElementById('over').hidden", False)
        page.keyboard.press("Escape")
        until(page, "document.getElementById('over').hidden")
        tab_to(page, "The scene")
        stand = page.evaluate("lang3dxl.view.mover.address")
        page.keyboard.press("s")
        until(page, f"lang3dxl.view.mover.address !== '{stand}'")
        page.keyboard.press("Home")
        page.keyboard.press("Enter")  # what is in the middle
        until(page, "document.getElementById('here').hidden", False)
        page.keyboard.press("Escape")
        until(page, "document.getElementById('here').hidden")
        assert prompts_of(page) == ["dome"]


@pytest.mark.slow
def test_a_visit_by_touch_alone(browser, address):
    with visit(browser, address, PHONE) as page:
        tap = lambda name, **how: page.get_by_role("button", name=name, exact=True, **how).first.tap()  # noqa: E731
        tap("windows")  # a suggestion
        until(page, "lang3dxl.prompts.length", 1)
        page.get_by_role("combobox", name="Look for").tap()
        page.keyboard.insert_text("dome")
        tap("Ask")
        until(page, "lang3dxl.prompts.length", 2)
        for name in ("Overview", "Copy link"):  # not below the fold
            box = page.get_by_role("button", name=name).bounding_box()
            assert box["y"] >= 0 and box["y"] + box["height"] <= PHONE["height"]
        tap("Fly to")
        until(page, "lang3dxl.view.mover.flight === null || !lang3dxl.view.mover.flight")
        tap("Overview")
        point = page.evaluate("lang3dxl.view.pixel([-0.8, -0.8, 0])")  # a window
        corner = page.locator("#frame canvas").bounding_box()
        page.touchscreen.tap(corner["x"] + point[0], corner["y"] + point[1])
        tap("Like this")
        until(page, "lang3dxl.prompts.length", 3)
        tap("Done")
        tap("Undo")
        until(page, "lang3dxl.prompts.length", 2)
        page.locator("#strip button").first.tap()
        until(page, "document.getElementById('over').hidden", False)
        tap("Hide photo")
        until(page, "document.getElementById('over').hidden")
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        page.locator("#more summary").tap()
        page.get_by_text(
            "Measure between two clicks"
        ).tap()  # far down the panel, which still tells what to do
        until(page, "document.getElementById('panel').scrollTop > 50")
        told = "document.getElementById('status').getBoundingClientRect().top - "
        told += "document.getElementById('panel').getBoundingClientRect().top"
        until(
            page,
            f"{told} >= 0 && document.getElementById('status').textContent",
            "Click one end of what you measure.",
        )


@pytest.mark.slow
@SIZES
def test_a_folded_panel_hides_nothing_that_is_told(browser, address, size):
    seen = """(id) => {
      const { left, top, right, bottom } = document.getElementById(id).getBoundingClientRect();
      const hit = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
      return Boolean(hit?.closest(`#${id}`)) && left >= 0 && right <= innerWidth; }"""
    with visit(browser, address, size) as page:
        page.get_by_role("button", name="Panel").click()
        assert not page.locator("#status").is_visible() and not page.locator("#word").is_visible()
        whole = page.evaluate("[document.getElementById('stage').clientWidth, innerWidth]")
        assert whole[0] == whole[1]
        page.evaluate("location.hash = 'ask=domme'")  # a word of a link, or of Back and Forward
        until(page, f"({seen})('near')")
        page.locator("#near").get_by_role("button").first.click()
        until(page, "lang3dxl.prompts.length", 1)
        page.locator("#frame").press("Enter")
        until(page, f"({seen})('here')")
        page.locator("#frame").press(".")
        until(page, f"({seen})('status')")
        assert not page.locator("#here").is_visible()  # it was told of another view
        for _ in range(3):
            page.locator("#frame").press("Escape")
        until(
            page,
            "['status', 'near', 'here'].some((id) => document.getElementById(id).checkVisibility())",
            False,
        )
        page.locator("#frame").press("/")  # starts typing here too
        until(page, f"({seen})('word') && document.activeElement.id", "word")


@pytest.mark.slow
@SIZES
def test_forced_colors_keep_the_colors_that_tell_prompts_apart(browser, address, size):
    with visit(browser, address, size, forced_colors="active") as page:
        page.evaluate("lang3dxl.ask('dome; windows')")
        cards = page.evaluate("""[...document.querySelectorAll("#prompts li")].map((card) => [
          getComputedStyle(card).borderLeftColor,
          getComputedStyle(card.querySelector(".heat")).backgroundImage])""")
        wanted = page.evaluate("lang3dxl.prompts.map(({ color }) => `rgb(${color.join(', ')})`)")
        assert [border for border, _ in cards] == wanted and len(set(wanted)) == 2
        assert all(rgb in heat for rgb, heat in cards)


@pytest.mark.slow
@SIZES
def test_axe_finds_nothing(browser, address, axe, size):
    run = """axe.run().then(({ violations }) =>
      violations.map(({ id, nodes }) => [id, nodes.map(({ html }) => html)]))"""
    with visit(browser, address, size) as page:
        page.evaluate(axe)
        assert page.evaluate(run) == []
        page.evaluate("lang3dxl.ask('dome; windows; zzz')")
        page.evaluate("document.getElementById('more').open = true")
        assert page.evaluate(run) == []
        page.get_by_role("button", name="Teach a word").click()
        page.locator("#strip button").first.click()
        until(page, "document.getElementById('over').hidden", False)
        assert page.evaluate(run) == []
        page.get_by_role("button", name="Panel").click()
        assert page.locator("#status").is_visible() and page.evaluate(run) == []
