"""Undo, Redo, Escape and addresses of the page: nothing is lost, and a link shows what one sees."""

import numpy as np
import pytest
from pages import DESK, SIDE, opened, picture, prompts_of, until, until_linked, until_told


@pytest.mark.slow
def test_escape_closes_and_deletes_nothing(page):
    page.evaluate("lang3dxl.ask('dome; windows')")
    page.get_by_role("button", name="Teach a word").click()
    page.get_by_text("Click on it in the view").wait_for()
    box = page.get_by_role("combobox", name="Look for")
    box.fill("wal")
    for where in ("#word", "#frame", "#frame", "#overview", "#frame"):
        page.locator(where).press("Escape")
    page.get_by_text("Click on it in the view").wait_for(state="detached")
    assert prompts_of(page) == ["dome", "windows"] and box.input_value() == "wal"
    box.fill("")
    page.evaluate(
        "Promise.all([lang3dxl.ask('wall'), lang3dxl.clear()])"
    )  # the running answer is dropped too
    until_linked(page, "ask=", False)
    assert prompts_of(page) == []


@pytest.mark.slow
def test_every_step_is_undone_and_redone_by_buttons_keys_and_the_browser(page):
    page.evaluate("lang3dxl.ask('dome')")
    page.evaluate("lang3dxl.ask('windows')")
    slider = page.get_by_label("Threshold of dome")
    slider.evaluate("""(slider) => { slider.value = 0.8;
      for (const kind of ["input", "change"]) slider.dispatchEvent(new Event(kind, { bubbles: true })); }""")
    page.get_by_role("button", name="Remove windows").click()
    told = "lang3dxl.prompts.map(({ text, threshold }) => text + threshold.toFixed(1)).join()"
    until(page, told, "dome0.8")
    until_linked(page, "at=0.8")
    before = ["dome0.8,windows0.3", "dome0.3,windows0.3", "dome0.3", ""]
    low = page.evaluate("lang3dxl.ask('dome').then(({ threshold }) => threshold.toFixed(1))")
    assert low == "0.8"  # asked again, a prompt keeps its threshold
    page.get_by_role("button", name="Undo").click()
    until(page, told, before[0])
    page.locator("#frame").press("Control+z")
    until(page, told, before[1])
    page.go_back()
    until(page, told, before[2])
    page.go_back()
    until(page, told, before[3])
    for shown in before[-2::-1]:
        page.locator("#frame").press("Control+Shift+z")
        until(page, told, shown)
    page.get_by_role("button", name="Redo").click()
    until(page, told, "dome0.8")


@pytest.mark.slow
def test_a_link_carries_thresholds_colors_and_moving(page, browser, address):
    page.evaluate("lang3dxl.ask('dome; windows')")
    page.evaluate("""() => {
      const slider = document.querySelector("#prompts li:last-child input[type=range]");
      slider.value = 0.77;
      for (const kind of ["input", "change"]) slider.dispatchEvent(new Event(kind, { bubbles: true }));
      const hide = document.getElementById("hide");
      hide.value = 0;  // shows floaters, which are hidden otherwise
      for (const kind of ["input", "change"]) hide.dispatchEvent(new Event(kind, { bubbles: true }));
    }""")
    page.get_by_role("button", name="Walk").click()
    page.get_by_role("button", name="Remove dome").click()
    until(page, "lang3dxl.prompts.length", 1)
    told = """[lang3dxl.prompts.map(({ text, threshold, color }) => [text, threshold, color]),
      lang3dxl.view.mover.walking, document.getElementById("hide").value, lang3dxl.view.mover.address]"""
    shown = page.evaluate(told)
    for part in ("at=0.77", "walk=1", "hide=0"):
        until_linked(page, part)
    until_linked(page, "dome", False)
    other = opened(browser, page.url, DESK)
    until(other, told, shown)
    assert shown[0][0][1] == 0.77
    other.close()
    page.get_by_role("button", name="Walk").click()


def test_a_link_is_copied_or_its_place_is_told(page):
    for clipboard, told in (
        ("{ writeText: (link) => (window.copied = link) }", "in the clipboard"),
        ("undefined", "address bar"),
    ):
        page.evaluate(
            f"Object.defineProperty(navigator, 'clipboard', {{ value: {clipboard}, configurable: true }})"
        )
        page.get_by_role("button", name="Copy link").click()
        until_told(page, "#status", told)
    assert page.evaluate("window.copied === location.href")


@pytest.mark.slow
def test_a_link_says_what_this_page_lacks_and_nothing_of_the_link_before(page):
    shown = "['near', 'status'].map((id) => document.getElementById(id).textContent).join(' ')"
    for link, told in (
        ("view=1,2&ask=dome", "doesn't have: view."),
        ("look=x.jpg&photo=y.jpg&like=z~999999", "doesn't have: photo, lighting, marks."),
        ("ask=zzz", "doesn't know “zzz”"),
        ("ask=dome&thing=999999+dome", "not among those found"),
    ):
        page.evaluate("(link) => { location.hash = link; }", link)
        until(page, f"{shown}.includes({told!r})")
    page.evaluate("location.hash = 'ask=windows'")
    until(page, "lang3dxl.prompts.map(({ text }) => text).join()", "windows")
    assert "zzz" not in page.evaluate(shown) and "not among" not in page.evaluate(shown)


@pytest.mark.slow
def test_a_flight_with_what_it_shows_is_one_step(page):
    page.emulate_media(reduced_motion="reduce")
    page.evaluate("lang3dxl.ask('windows')")
    page.locator("#prompts summary").click()
    page.locator("#prompts ol button").nth(1).wait_for()
    until_linked(page, "ask=")
    page.get_by_role("button", name="Walk").click()
    until_linked(page, "walk=1")
    stand = "lang3dxl.view.mover.address"
    before = page.evaluate(f"[{stand}, history.state.step]")
    page.locator("#prompts ol button").nth(1).click()  # flies to a thing, and no longer walks
    until_linked(page, "thing=")
    page.get_by_role("button", name="Hide the rest").click()
    until_linked(page, "alone=1")
    page.wait_for_timeout(500)
    assert page.evaluate("history.state.step") == before[1] + 2
    for name in ("Undo", "Redo", "Undo", "Undo"):
        page.get_by_role("button", name=name).click()
        until_linked(page, "alone=1", name == "Redo")
        page.wait_for_timeout(500)  # a thing is chosen again once its word is answered: no step
    until_linked(page, "thing=", False)
    until(page, f"[{stand}, history.state.step]", before)
    assert not page.get_by_role("button", name="Redo").is_disabled()
    page.get_by_role("button", name="Walk").click()


@pytest.mark.slow
def test_of_two_addresses_the_later_one_is_shown(page):
    page.evaluate("location.hash = 'ask=windows&ask=wall&ask=belfry&not=sky'")
    page.evaluate("location.hash = 'ask=dome'")
    until_linked(page, "ask=%22dome%22")  # the page's own spelling: it has answered
    page.wait_for_timeout(1500)
    assert prompts_of(page) == ["dome"] and "ask=%22dome%22" in page.url and "wall" not in page.url


@pytest.mark.slow
@pytest.mark.parametrize("text", ["window%3B", "ask=window&ask=", "a" + "%20" * 32_000 + "b", "%22a", "not+"])
def test_a_link_of_any_length_opens_at_once_with_at_most_twenty_prompts(page, text):
    page.evaluate(f"location.hash = 'ask=' + {text!r}.repeat({text!r}.length > 99 ? 1 : 10000)")
    until(page, "document.querySelectorAll('#prompts > *').length < 21")
    assert page.evaluate("lang3dxl.ask('dome')")["known"]  # the page answers again
    assert len(prompts_of(page)) <= 21


@pytest.mark.slow
def test_flying_leads_to_the_best_view_and_its_link_back_to_it(page, scene, browser, address):
    page.evaluate("lang3dxl.ask('windows')")
    page.get_by_role("button", name="Fly to").click()
    there = picture(page)
    until_linked(page, "ask=")
    until_linked(page, "view=")
    link = page.url
    page.evaluate("lang3dxl.clear()")
    best = scene.render(scene.find("windows").views[0].name, size=SIDE).pixels.astype(int)
    assert np.abs(picture(page) - best).mean() < 6
    other = opened(browser, link, DESK)  # two pages at once
    until(other, "lang3dxl.prompts.map(({ text }) => text).join()", "windows")
    assert np.abs(picture(other) - there).mean() < 3
    assert other.complaints == []
    other.close()
