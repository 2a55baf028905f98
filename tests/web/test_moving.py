"""Moving in the page: walking, orbiting, limits, cameras, and pictures that keep up."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from pages import DESK, PHONE, PRESS, SIDE, TAPS, opened, picture, rest, served, until, until_told
from painted_scene import painted_file, painted_scene

from lang3dxl_ns.web.write_page import Page, write_page


@pytest.mark.slow
def test_cameras_are_drawn_and_doubtful_ones_apart_with_their_reason(browser, tmp_path):
    file = painted_file()
    photos = [
        replace(photo, doubtful="it looks away" if k == 1 else None) for k, photo in enumerate(file.photos)
    ]
    write_page(Page(painted_scene(file=replace(file, photos=photos))), tmp_path)
    with served(tmp_path) as address:
        page = opened(browser, address, DESK)
        page.evaluate("lang3dxl.view.mover.free = true")
        page.evaluate(f"{TAPS}('s', 12)")  # until the cameras stand before the eye
        page.get_by_role("button", name="Cameras").click()
        drawn = (
            "(kind) => document.querySelector(`#pyramids .${kind}`).getAttribute('d').split('M').length - 1"
        )
        rest(page)
        assert [page.evaluate(drawn, kind) for kind in ("sure", "doubtful")] == [8, 4]  # edges
        page.get_by_role("button", name="Next view").click()
        page.get_by_role("button", name="Next view").click()
        until_told(page, "#status", "doubtful: it looks away")
        page.close()


@pytest.mark.slow
def test_a_slow_machine_draws_drafts_until_nothing_changes(page):
    picture(page)
    width = page.evaluate("document.querySelector('#frame canvas').width")
    draft = page.evaluate("""async () => {
      const { view } = lang3dxl, { cost } = view;
      view.cost = 8e3;  // a draft for two seconds
      view.wake();
      await new Promise(requestAnimationFrame);
      await new Promise(requestAnimationFrame);
      view.cost = cost;
      return document.querySelector("#frame canvas").width;
    }""")
    assert draft == pytest.approx(0.3 * width, abs=1)
    rest(page)
    assert page.evaluate("document.querySelector('#frame canvas').width") == width == SIDE


@pytest.mark.slow
def test_one_walks_looks_and_orbits_by_keys(page):
    stand = """() => { const { position, target } = lang3dxl.view.mover.stand;
      return [position.toArray(), target.toArray()]; }"""
    page.evaluate("lang3dxl.view.mover.free = true")

    def after(key):
        before = np.array(page.evaluate(stand))
        page.locator("#frame").press(key)
        return before, np.array(page.evaluate(stand))

    before, now = after("ArrowLeft")  # around the target
    assert np.allclose(before[1], now[1]) and not np.allclose(before[0], now[0])
    up = np.array(page.evaluate("lang3dxl.view.camera.up.toArray()"))
    for key, axis in (
        ("w", "ahead"),
        ("s", "back"),
        ("a", "left"),
        ("d", "right"),
        ("e", "up"),
        ("q", "down"),
    ):
        before, now = after(key)
        way, ahead = now[0] - before[0], before[1] - before[0]
        assert np.allclose(now[1] - now[0], ahead, atol=1e-4)  # the view stays
        level = ahead - up * (ahead @ up)
        right = np.cross(level, up)
        aim = {"ahead": level, "back": -level, "left": -right, "right": right, "up": up, "down": -up}[axis]
        assert way @ aim > 0.99 * np.linalg.norm(way) * np.linalg.norm(aim) > 0
    before, now = after("ArrowRight")  # walking, arrows look
    assert np.allclose(before[0], now[0]) and not np.allclose(before[1], now[1])
    page.evaluate("lang3dxl.view.mover.free = false")
    page.locator("button[aria-pressed=true]", has_text="Walk").wait_for()


@pytest.mark.slow
def test_the_eye_stays_before_the_wall_unless_shift_is_held(page):
    until(page, "Boolean(lang3dxl.view.mover.space)")
    depth = "lang3dxl.view.mover.camera.position.z"  # the wall is z = 0
    page.evaluate(f"{TAPS}('w', 40)")
    near = page.evaluate(depth)
    assert -2.5 < near < 0
    until_told(page, "#status", "hold Shift")
    page.evaluate(f"{TAPS}('W', 40, {{ shiftKey: true }})")
    assert page.evaluate(depth) > 0.5
    page.get_by_role("button", name="Overview").click()
    page.locator("button[aria-pressed=false]", has_text="Walk").wait_for()


@pytest.mark.slow
def test_the_first_view_is_fitted_again_to_what_a_panel_leaves_until_one_moves(browser, address):
    page = opened(browser, address, PHONE)
    fitted = """(({ stand }, whole = lang3dxl.view.mover.overviewStand()) =>
      Math.abs(stand.fov - whole.fov) + stand.target.distanceTo(whole.target) < 1e-6)(lang3dxl.view.mover)"""
    grow = "(css) => document.styleSheets[0].insertRule(css, document.styleSheets[0].cssRules.length)"
    until(page, fitted)
    for height in ("max-height: 20%", "min-height: 60%"):
        before = page.evaluate("lang3dxl.view.mover.aspect")
        page.evaluate(grow, f"#panel {{ {height} }}")
        until(page, f"lang3dxl.view.mover.aspect !== {before} && {fitted}")
    page.locator("#frame").press("+")
    before = page.evaluate("lang3dxl.view.mover.address")
    page.set_viewport_size({"width": 844, "height": 390})
    until(page, "innerWidth", 844)
    page.wait_for_timeout(300)
    assert page.evaluate("lang3dxl.view.mover.address") == before
    page.close()


@pytest.mark.slow
def test_a_link_opened_in_a_narrower_window_shows_as_much_to_both_sides(page, browser, address):
    page.set_viewport_size({"width": 1440, "height": 600})
    page.locator("#frame").press("+")
    wide = "Math.tan(lang3dxl.view.camera.fov * Math.PI / 360) * lang3dxl.view.camera.aspect"
    until(page, "location.hash.includes(`shape=${lang3dxl.view.mover.aspect.toFixed(2)}`)")
    shown, link = page.evaluate(wide), page.url
    page.set_viewport_size(DESK)
    for size in (PHONE, {"width": 1600, "height": 400}):
        other = opened(browser, link, size)
        assert page.evaluate("lang3dxl.view.camera.fov") <= other.evaluate("lang3dxl.view.camera.fov") + 1e-3
        assert other.evaluate(wide) >= 0.98 * min(shown, 1.4 * other.evaluate("lang3dxl.view.camera.aspect"))
        other.close()


@pytest.mark.slow
def test_a_double_click_turns_around_what_is_there(page, scene):
    camera = scene.overview.full_camera
    x, y, z = camera.intrinsics.numpy() @ camera.view_matrix[:3].numpy() @ [1.5, 1.5, 0, 1]
    corner = page.locator("#frame canvas").bounding_box()
    page.emulate_media(reduced_motion="reduce")
    page.mouse.dblclick(corner["x"] + SIDE * x / z / camera.width, corner["y"] + SIDE * y / z / camera.width)
    for _ in range(50):
        page.wait_for_timeout(100)
        target = page.evaluate("lang3dxl.view.mover.stand.target.toArray()")
        if abs(target[0] - 1.5) < 0.15:
            break
    np.testing.assert_allclose(target, [1.5, 1.5, 0], atol=0.15)


@pytest.mark.slow
def test_with_two_fingers_one_walks_and_with_one_one_looks(browser, address):
    page = opened(browser, address, PHONE)
    page.get_by_role("button", name="Walk").click()
    drag = """(fingers) => {
      const canvas = document.querySelector("#frame canvas"), before = lang3dxl.view.mover.stand;
      const send = (kind, id, x, y) => canvas.dispatchEvent(new PointerEvent(kind,
        { pointerId: id, pointerType: "touch", isPrimary: id === 1, clientX: x, clientY: y, bubbles: true }));
      canvas.setPointerCapture = () => {};
      for (let id = 1; id <= fingers; id++) send("pointerdown", id, 100 + 50 * id, 200);
      for (let id = 1; id <= fingers; id++) send("pointermove", id, 100 + 50 * id, 240);
      for (let id = 1; id <= fingers; id++) send("pointerup", id, 100 + 50 * id, 240);
      const now = lang3dxl.view.mover.stand;
      return [now.position.distanceTo(before.position), now.target.clone().sub(now.position)
        .angleTo(before.target.clone().sub(before.position))];
    }"""
    page.evaluate("lang3dxl.view.mover.free = true")
    moved, turned = page.evaluate(drag, 1)
    assert moved < 1e-6 and turned > 0.05
    moved, turned = page.evaluate(drag, 2)
    assert moved > 1e-3 and turned < 1e-4
    page.close()


@pytest.mark.slow
def test_shortcuts_of_the_browser_do_not_steer(page):
    steered = f"""[{{ ctrlKey: true }}, {{ metaKey: true }}, {{ altKey: true }}, {{}}].map((held) =>
      !{PRESS}("-", held) || !{PRESS}("ArrowLeft", held))"""
    assert page.evaluate(steered) == [False, False, False, True]


@pytest.mark.slow
def test_letters_that_a_keyboard_lacks_are_found_by_their_place(page):
    """On a Cyrillic one, for example. On a Latin one, such as AZERTY, what is written on a key counts."""
    held = "[...lang3dxl.view.mover.held.keys()].join()"
    for key, code, meant in (("ц", "KeyW", "w"), ("Ц", "KeyW", "w"), ("w", "KeyZ", "w"), ("z", "KeyW", "")):
        page.evaluate(f"{PRESS}('{key}', {{ code: '{code}' }})")
        assert page.evaluate(held) == meant
        page.evaluate(f"dispatchEvent(new KeyboardEvent('keyup', {{ key: '{key}', code: '{code}' }}))")
        assert page.evaluate(held) == ""
    page.evaluate("dispatchEvent(new Event('keyup'))")  # as Chrome sends when a suggestion is chosen
    page.evaluate("lang3dxl.ask('dome')")
    until(page, "lang3dxl.prompts.length", 1)
    page.evaluate(f"{PRESS}('я', {{ code: 'KeyZ', ctrlKey: true }})")
    until(page, "lang3dxl.prompts.length", 0)


@pytest.mark.slow
def test_a_lost_picture_comes_back(page):
    page.evaluate("lang3dxl.ask('dome')")
    before = picture(page)
    page.evaluate("""async () => {
      window.loss = lang3dxl.view.renderer.getContext().getExtension("WEBGL_lose_context");
      lang3dxl.view.wake();
      await new Promise(requestAnimationFrame);
      loss.loseContext();
      lang3dxl.view.wake();
    }""")
    page.wait_for_timeout(500)
    page.evaluate("loss.restoreContext()")
    assert np.abs(picture(page) - before).max() <= 2


@pytest.mark.slow
def test_an_overview_fits_what_buttons_and_photos_leave_free_of_every_window(page):
    overview = """([extent, photos]) => {
      const { mover, about } = lang3dxl.view, before = about.extent, $ = (id) => document.getElementById(id);
      about.extent = extent;
      $("strip").hidden = !photos;
      $("strip").style.height = "76px";
      const { position, target, fov } = mover.overviewStand(), frame = mover.frame.getBoundingClientRect();
      const free = [$("tools").getBoundingClientRect().bottom, frame.bottom - 76 * photos];
      const shape = [frame.width, frame.height, ...free.map((y) => y - frame.top)];
      about.extent = before;
      $("strip").hidden = true;
      return [position.toArray(), target.toArray(), [fov], about.up, about.start.pose, shape];
    }"""
    extents = ([-0.5, -0.4, 0.5, 0.3, 5], [-0.2, -0.6, 0.3, 0.1, 5], [-0.9, -0.3, 0.9, 0.3, 5])
    for window in ((1440, 900), (390, 844), (840, 390)):
        page.set_viewport_size(dict(zip(("width", "height"), window, strict=True)))
        until(page, "innerWidth", window[0])
        for extent, photos in itertools.product(extents, (0, 1)):
            found = page.evaluate(overview, [extent, photos])
            place, target, (fov,), up, pose, (wide, high, first, last) = map(np.array, found)
            np.testing.assert_allclose(place, pose[:3, 3])  # what is farther back, no photo shows from behind
            ahead = (target - place) / np.linalg.norm(target - place)
            right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
            left, top, end, bottom, _ = extent
            ways = (
                np.array([[left, 0, 1], [end, 0, 1], [0, top, 1], [0, bottom, 1]])
                * [1, -1, -1]
                @ pose[:3, :3].T
            )
            slopes = ways @ np.stack([right, np.cross(ahead, right)], axis=1) / (ways @ ahead)[:, None]
            pixels = slopes * high / 2 / np.tan(np.radians(fov) / 2) + [wide / 2, high / 2]
            inside = -0.03 * wide <= pixels[0, 0] < pixels[1, 0] <= 1.03 * wide
            assert inside or fov > 109.9, (extent, window)  # the widest lens
            assert first <= pixels[2, 1] < pixels[3, 1] <= last, (extent, window, photos)
    page.set_viewport_size(DESK)
