"""Asking in a scene's page, in Chromium: prompts, clicks and messages, without a server or the Internet."""

import numpy as np
import pytest
from pages import (
    DESK,
    HOSTILE,
    PHONE,
    SIDE,
    cells,
    opened,
    picture,
    prompts_of,
    served,
    until,
    until_linked,
    until_told,
)
from painted_scene import painted_looks, painted_scene
from PIL import Image

from lang3dxl_ns.web.write_page import Page, write_page
from lang3dxl_ns.words.taught_words import Example


@pytest.mark.slow
def test_a_typed_word_lights_up_where_it_is(page, scene):
    before = picture(page)
    camera = scene.overview.full_camera
    assert np.abs(before - scene.render(camera, size=SIDE).pixels.astype(int)).mean() < 6
    page.get_by_role("combobox", name="Look for").fill("dome")
    page.keyboard.press("Enter")
    page.locator("#prompts strong", has_text="dome").wait_for()
    changed = cells(np.abs(picture(page) - before).max(2) > 40)
    question = scene.ask("dome")  # a page composites at its own size
    drawn = scene.draw(scene.camera(camera, SIDE), question.channels)
    there = cells(question.maps(drawn)[1][0].numpy())
    assert there.sum() >= 20 and (changed & there).sum() > 0.9 * (changed | there).sum()
    page.get_by_role("button", name="Remove dome").click()
    assert np.abs(picture(page) - before).max() <= 2


@pytest.mark.slow
def test_a_click_tells_what_is_there(page, scene):
    camera = scene.overview.full_camera
    matrix, size = camera.intrinsics.numpy() @ camera.view_matrix[:3].numpy(), camera.width
    x, y, z = matrix @ [1.5, 1.5, 0, 1]
    x, y = SIDE * x / z / size, SIDE * y / z / size
    found = page.evaluate("([x, y]) => lang3dxl.whatIs(x, y)", [x, y])
    expected = scene.what_is(camera, x, y, size=SIDE)
    assert found[0][0] == expected[0][0] and found[0][1] == pytest.approx(expected[0][1], abs=0.01)
    corner = page.locator("#frame canvas").bounding_box()
    page.mouse.click(corner["x"] + x, corner["y"] + y)
    page.locator("#here").get_by_role("button", name=expected[0][0], exact=False).first.click()
    page.locator("#prompts strong").wait_for()
    page.mouse.click(corner["x"] + x, corner["y"] + y)
    page.get_by_role("button", name="Like this").click()
    name = page.get_by_role("textbox", name="Name")
    name.wait_for()
    name.fill("my dome~")
    name.press("Enter")
    until_linked(page, "like=my+dome")
    page.get_by_role("button", name="Not this").click()
    window = matrix @ [-0.8, -0.8, 0, 1]
    at = corner["x"] + SIDE * window[0] / window[2] / size, corner["y"] + SIDE * window[1] / window[2] / size
    page.mouse.click(*at)
    page.get_by_text("2 examples").wait_for()
    until_linked(page, "%7E-")
    page.get_by_role("button", name="Undo").click()
    page.get_by_text("1 example").wait_for()
    until_linked(page, "%7E-", False)
    page.get_by_role("button", name="Redo").click()
    page.get_by_text("2 examples").wait_for()


@pytest.mark.slow
def test_a_named_word_is_kept_offered_and_forgotten(page, scene, browser, address):
    rows = ".".join(map(str, scene.ask("dome").gaussians[0].nonzero()[:3, 0].tolist()))
    page.evaluate(f"location.hash = 'like=cupola+of+mine~{rows}'")
    name = page.get_by_role("textbox", name="Name")
    name.fill("my cupola")
    name.press("Enter")
    until(page, "lang3dxl.prompts.map(({ text }) => text).join()", "my cupola")
    page.evaluate("lang3dxl.clear()")
    box = page.get_by_role("combobox", name="Look for")
    box.fill("my cu")
    option = page.locator("#offered option[value='my cupola']")
    option.wait_for(state="attached")
    page.evaluate("lang3dxl.ask('my cupola')")
    found = page.evaluate("lang3dxl.ask('My Cupola')")
    assert page.locator("#prompts li").count() == 1
    assert found["known"] and found["matching"] == int(scene.ask("dome").gaussians[0].sum())
    page.get_by_role("button", name="Add").click()
    page.get_by_role("button", name="Forget").click()
    until(page, "lang3dxl.prompts.length", 0)
    assert page.evaluate("lang3dxl.ask('my cupola')")["known"] is False
    assert page.locator("#prompts li").count() == 0


@pytest.mark.slow
def test_a_scene_suggests_its_own_words_and_taught_ones_first_and_splits_none_of_them(browser, tmp_path):
    scene = painted_scene().teach("Lords and ladies", Example("all/0003.jpg", points=((69, 69),)))
    write_page(Page(scene), tmp_path)
    with served(tmp_path) as address:
        page = opened(browser, address, DESK)
        offered = page.locator("#try button")
        offered.first.wait_for()
        words = offered.all_inner_texts()
        assert words[0] == "Lords and ladies" and "windows" in words and "minarets" not in words
        page.get_by_role("combobox", name="Look for").focus()
        page.locator("#offered option").first.wait_for(state="attached")
        listed = page.evaluate("[...document.querySelectorAll('#offered option')].map(({ value }) => value)")
        assert listed[: len(words)] == words
        page.evaluate("lang3dxl.ask('windows and lords and ladies')")
        assert [text.lower() for text in prompts_of(page)] == ["windows", "lords and ladies"]
        assert page.complaints == []
        page.close()


@pytest.mark.slow
def test_ask_answers_and_hostile_texts_stay_texts(page):
    answer = page.evaluate("lang3dxl.ask('dome')")
    assert answer["known"] and answer["matching"] > 50 and 0 < answer["threshold"] < answer["peak"] <= 1
    for text in (HOSTILE, "", ";;;", "x" * 5000, "__proto__", "constructor"):
        assert page.evaluate("(text) => lang3dxl.ask(text)", text)["known"] is False
        told = page.locator("#status").inner_text()
        assert ("prompt is empty" in told) == (text == ";;;"), text
    assert page.locator("h1").inner_text() == HOSTILE and page.title() == HOSTILE
    assert page.locator("img:not(#photo)").count() == 0
    page.evaluate("location.hash = 'view=nan,1,2&ask=%22%3Cimg%20src=x%3E&like=~x~-1.9e9~'")
    page.wait_for_timeout(500)
    assert page.locator("img:not(#photo)").count() == 0


@pytest.mark.slow
def test_at_the_width_of_a_phone_everything_is_in_reach(browser, address):
    page = opened(browser, address, PHONE)
    page.evaluate("lang3dxl.ask('dome; windows')")
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    shape = page.locator("#frame canvas").bounding_box()
    assert shape["width"] == PHONE["width"] and shape["height"] >= 0.45 * PHONE["height"]
    for name in ("Ask", "Overview", "Still picture", "Copy link"):
        button = page.get_by_role("button", name=name, exact=True)
        button.scroll_into_view_if_needed()
        assert button.bounding_box()["height"] >= 40
    assert picture(page).std() > 5 and page.complaints == []
    page.close()


@pytest.mark.slow
def test_a_phone_opens_at_the_search_box_and_scrolls_to_what_is_asked(browser, address):
    page = opened(browser, address + "#ask=dome&ask=windows&ask=wall", PHONE)
    page.locator("#prompts strong", has_text="wall").wait_for()
    scrolled = "document.getElementById('panel').scrollTop"
    assert page.evaluate(scrolled) == 0
    page.evaluate("lang3dxl.ask('wall')")
    until(page, f"{scrolled} > 0")
    page.close()


@pytest.mark.slow
def test_a_dragged_threshold_is_followed_at_once(page):
    page.evaluate("lang3dxl.ask('dome')")
    milliseconds, heated = page.evaluate("""() => {
      const slider = document.querySelector("#prompts input[type=range]"), start = performance.now();
      slider.value = 0.99;
      slider.dispatchEvent(new Event("input", { bubbles: true }));
      return [performance.now() - start, lang3dxl.view.layers.includes(0.99)];
    }""")
    assert heated and milliseconds < 5000  # in the same turn
    page.evaluate("document.querySelector('#prompts input[type=range]').dispatchEvent(new Event('change'))")
    relevancy = page.evaluate("[...lang3dxl.prompts[0].relevancy]")
    until(page, "lang3dxl.prompts[0].matching", sum(value > 0.99 for value in relevancy))


@pytest.mark.slow
def test_no_match_is_left_nothing_to_fly_to_and_no_word_of_the_earlier_view(page):
    page.evaluate("lang3dxl.ask('dome').then(() => true)")
    until(page, "document.querySelector('.fly').disabled", False)
    page.evaluate("document.querySelector('.fly').click()")
    until_told(page, "#status", "View 1 of")
    page.evaluate("""() => {
      const slider = document.querySelector("#prompts input[type=range]");
      slider.value = 1;
      for (const kind of ["input", "change"]) slider.dispatchEvent(new Event(kind, { bubbles: true }));
    }""")
    until(page, "document.getElementById('status').textContent.includes('View 1 of')", False)
    until(page, "lang3dxl.prompts[0].views?.some((view) => view.shown)", False)
    until(page, "document.querySelector('.fly').disabled")
    until_told(page, "#prompts", "Nothing fits above the threshold")


@pytest.mark.slow
def test_the_same_prompt_asked_twice_at_once_has_one_card(page):
    page.evaluate("Promise.all(['dome', 'dome', 'windows'].map((text) => lang3dxl.ask(text)))")
    assert prompts_of(page) == ["dome", "windows"]
    colors = (
        "[...document.querySelectorAll('#prompts li')].map((card) => card.style.getPropertyValue('--color'))"
    )
    assert len(set(page.evaluate(colors))) == 2


@pytest.mark.slow
@pytest.mark.parametrize("file", ["page.js", "splats.*.bin"])
def test_a_word_that_is_typed_while_the_page_loads_is_answered_then(browser, address, file):
    page, held = browser.contexts[0].new_page(), []
    page.on("console", lambda message: held.append(message.text))
    page.route(f"**/{file}", lambda route: held.append(route))
    page.goto(address, wait_until="commit")
    until(page, lambda: len(held), 1)
    page.get_by_role("combobox", name="Look for").fill("dome")
    page.keyboard.press("Enter")
    page.wait_for_timeout(200)
    (waiting,) = held  # and no complaint
    waiting.continue_()
    until(page, "window.lang3dxl?.prompts.map(({ text }) => text).join()", "dome")
    page.close()


@pytest.mark.slow
def test_an_unknown_negative_is_replaced_by_the_one_chosen(page):
    page.evaluate("""lang3dxl.ask('"dome" not "belfrey"')""")
    page.locator("#near").get_by_role("button", name="belfry", exact=True).click()
    page.get_by_text("dome not belfry").wait_for()
    page.evaluate("lang3dxl.ask('belfrey; dome; zzz')")  # each that isn't known is told
    assert [told.split("”")[0] for told in page.locator("#near span").all_inner_texts()] == [
        f"This page doesn't know “{word}" for word in ("belfrey", "zzz")
    ]
    page.locator("#near").get_by_role("button", name="belfry", exact=True).click()
    page.get_by_text("belfry", exact=True).wait_for()
    until(page, "document.getElementById('near').textContent", "")


@pytest.mark.slow
def test_a_new_example_takes_a_number_that_is_free(page, scene):
    camera = scene.overview.full_camera
    x, y, z = camera.intrinsics.numpy() @ camera.view_matrix[:3].numpy() @ [1.5, 1.5, 0, 1]
    corner = page.locator("#frame canvas").bounding_box()
    names = page.get_by_role("textbox", name="Name")

    def like_the_dome():
        page.mouse.click(corner["x"] + SIDE * x / z / camera.width, corner["y"] + SIDE * y / z / camera.width)
        page.get_by_role("button", name="Like this", exact=True).click()
        page.get_by_text("1 example:").wait_for()
        page.get_by_role("button", name="Done").click()
        page.get_by_role("button", name="Done").wait_for(state="detached")
        return [one.input_value() for one in names.all()]

    assert like_the_dome() == ["like this 1"] and like_the_dome() == ["like this 1", "like this 2"]
    page.get_by_role("button", name="Remove like this 1").click()
    until(page, "lang3dxl.prompts.length", 1)
    assert like_the_dome() == ["like this 2", "like this 3"]


@pytest.mark.slow
def test_a_still_picture_is_what_one_sees(page):
    page.evaluate("lang3dxl.ask('dome')")
    shown = picture(page)
    with page.expect_download() as saved:
        page.get_by_role("button", name="Still picture").click()
    still = np.asarray(Image.open(saved.value.path()).convert("RGB")).astype(int)
    assert still.shape == shown.shape and np.abs(still - shown).mean() < 1


@pytest.mark.slow
def test_without_webgl_it_says_what_helps(browser, address):
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(address)
    page.evaluate("lang3dxl.ready.catch(() => true)")
    page.get_by_role("combobox", name="Look for").press("Enter")
    page.wait_for_timeout(300)
    until_told(page, "#status", "hardware acceleration")
    page.close()


@pytest.mark.slow
def test_a_script_that_cant_run_is_told(browser, address):
    """As by servers on Windows, whose registry may call .js files text, and in browsers that are too old."""
    lost, text, odd = {"status": 404}, {"content_type": "text/plain"}, {"body": "let = ="}
    told = {}
    for script, answer in (("page", lost), ("page", odd), ("history", lost), ("history", text)):
        page = browser.new_page()
        told.update({"status": 200, "body": "export {}", "content_type": "text/javascript"} | answer)
        page.route(f"**/{script}.js", lambda route: route.fulfill(**told))
        page.goto(address)
        until_told(page, "#status", "The page's scripts can't run")
        page.close()


@pytest.mark.slow
def test_a_scene_without_words_cant_be_typed_to(browser, tmp_path):
    write_page(Page(painted_scene(decoder=None, codes=None)), tmp_path)
    with served(tmp_path) as address:
        page = opened(browser, address + "#ask=dome&like=it~1", DESK)
        assert page.get_by_role("combobox", name="Look for").is_disabled()
        assert page.get_by_role("button", name="Ask").is_disabled() and prompts_of(page) == []
        assert page.get_by_role("checkbox", name="Measure", include_hidden=True).is_disabled()
        until_told(page, "#status", "no words yet")
        page.get_by_role("button", name="Walk").click()
        page.get_by_role("button", name="Overview").click()
        until(page, "document.getElementById('walk').ariaPressed", "false")
        until_told(page, "#status", "no words yet")
        assert page.complaints == []
        page.close()


@pytest.mark.slow
def test_an_over_long_phrase_is_cut_before_it_is_sent(browser, address):
    page = browser.new_page()
    page.goto(address + "LICENSES.txt")
    sent = page.evaluate("""async () => {
      const { Vocabulary } = await import("/vocabulary.js"), sent = [];
      const described = { words: [], negatives: [], taught: {}, special: {} };
      window.fetch = async (address) => (sent.push(address), { ok: true, json: async () => ({}) });
      await new Vocabulary(described, new ArrayBuffer(0), 3, true).phrase("𝒙".repeat(5000));
      return decodeURIComponent(sent[0]);
    }""")
    assert sent == "api/encode?text=" + 2000 * "𝒙"
    page.close()


@pytest.mark.slow
def test_from_a_folder_it_says_what_it_needs(browser, scene, tmp_path):
    write_page(Page(scene), tmp_path)
    page = browser.new_page()
    page.goto(f"file://{tmp_path}/index.html")
    until_told(page, "#status", "http.server")
    page.close()


TWO_LIGHTINGS = """async () => {
  const look = document.getElementById("look"), names = [...look.options].map((one) => one.value);
  const { fetch } = window, wait = (seconds) => new Promise((done) => setTimeout(done, 1000 * seconds));
  const delays = [0.5, 0];
  let shown = 0;
  window.fetch = async (file) => (await wait(delays.shift()), fetch(file));
  lang3dxl.view.light = () => shown++;
  for (const name of names.filter(Boolean).slice(0, 2)) {
    look.value = name;
    look.dispatchEvent(new Event("change"));
  }
  while (delays.length || !shown) await wait(0.1);
  await wait(1.5);
  return shown;
}"""


@pytest.mark.slow
def test_of_two_lightings_the_one_chosen_last_is_shown(browser, tmp_path):
    write_page(Page(painted_scene(looks=painted_looks())), tmp_path)
    with served(tmp_path) as address:
        page = opened(browser, address, DESK)
        assert page.evaluate(TWO_LIGHTINGS) == 1
        page.close()
