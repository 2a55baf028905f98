"""The page of `lang3dxl view` in Chromium: photos over the rendering, and words that its scene is taught."""

import errno
import http.client
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from pages import DESK, live, opened, rest, served, until, until_linked, until_told
from painted_scene import painted_scene
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.scene_file import describe_scene_file, keep_words, read_scene
from lang3dxl_ns.query.floaters import FLOATS
from lang3dxl_ns.web.photos import PHOTO_SIDE, small_photo
from lang3dxl_ns.web.write_page import Page, write_page
from lang3dxl_ns.words.taught_words import Example, load_words

ALL = "all/0003.jpg"


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Renderings of the painted wall as its photos, with a frame that tells photo and rendering apart."""
    folder, scene = tmp_path_factory.mktemp("photos"), painted_scene()
    for photo in scene.photos:
        pixels = scene.render(photo.full_camera, size=384).pixels.copy()
        pixels[..., 0] = 255
        (folder / photo.name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).resize(photo.file_size).save(folder / photo.name, quality=95)
    return folder


def posted(server, content, path="/api/teach", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    origin = f"http://127.0.0.1:{server.server_port}"
    told = {"Content-Type": "application/json", "Origin": origin} | headers
    told = {name: value for name, value in told.items() if value is not None}
    connection.request("POST", path, content, told)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def in_file(file):
    return {word.name: word.to_json() for word in describe_scene_file(file)["taught"]}


CLICK = {"photo": ALL, "points": [[69, 69]], "not_points": [[37, 37]], "size": [96, 96]}


def test_marks_of_a_page_teach_the_bytes_of_python(file):
    example = Example(ALL, points=((69, 69),), not_points=((37, 37),))
    expected = read_scene(file, "cpu")
    expected = expected.teach("cupola", example).words["cupola"].to_json()
    with live(file) as server:
        status, told = posted(server, json.dumps({"name": "cupola", "before": "cupola", "examples": [CLICK]}))
        assert status == 200 and "wall.scene keeps it" in told
        assert in_file(file) == {"cupola": expected}
        assert server.page.answer("Cupola")["taught"]["doubt"] == expected["doubt"]


def test_a_page_replaces_its_own_marks_and_keeps_those_of_others(file):
    scene = read_scene(file, "cpu")
    before = scene.teach("cupola", Example("right/0002.jpg", points=((48, 48),))).words
    keep_words(file, before)
    with live(file) as server:
        for name, marks, expected in (
            ("cupola", [CLICK], 2),
            ("cupola", [CLICK | {"not_points": []}], 2),
            ("dome of mine", [CLICK], 1),  # renamed
        ):
            former = "cupola" if name != "cupola" else name
            content = {"name": name, "before": former, "examples": marks}
            assert posted(server, json.dumps(content))[0] == 200
            assert len(in_file(file)[name]["examples"]) == expected
        assert in_file(file)["cupola"]["examples"] == before["cupola"].to_json()["examples"]
        assert posted(server, marks_of("dome of mine")) == (
            200,
            '{"told": "The scene forgot \'dome of mine\'."}',
        )
        status, told = posted(server, marks_of("cupola"))
        assert status == 200 and "stay (1): lang3dxl words" in told and "--forget cupola" in told
    assert list(in_file(file)) == ["cupola"]


def marks_of(name, *examples):
    return json.dumps({"name": name, "before": name, "examples": examples})


def test_marks_are_kept_once_and_forgotten_after_a_refusal_and_another_server(file):
    other, more = (CLICK | {"points": points} for points in ([[70, 70]], [[70, 70], [71, 71]]))
    with live(file) as server:
        for marks, status in ((CLICK, 200), (CLICK | {"points": [[690, 69]]}, 400), (other, 200)):
            assert posted(server, marks_of("cupola", marks))[0] == status
            assert len(in_file(file)["cupola"]["examples"]) == 1
    with live(file) as server:
        assert posted(server, marks_of("cupola", more))[0] == 200
        (example,) = in_file(file)["cupola"]["examples"]
        assert len(example["points"]) == 2
        assert posted(server, marks_of("cupola"))[0] == 200
    assert in_file(file) == {}


def test_a_full_disk_is_told_and_changes_nothing(file, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device", "wall.scene")

    with live(file) as server:
        for room, name in (("teach", "keep_words"), ("write_page", "small_photo")):
            monkeypatch.setattr(f"lang3dxl_ns.web.{room}.{name}", full)
        server.page.photos = file.parent
        for answer in (
            posted(server, marks_of("cupola", CLICK)),
            posted(server, json.dumps({"tour": "#stop=", "before": ""}), "/api/tour"),
            got(server, f"/api/photo?name={ALL}"),
        ):
            assert answer[0] == 400 and "wall.scene: No space left on device; " in answer[1]
        assert "cupola" not in server.page.scene.words and server.page.provenance.tour == ""
        monkeypatch.undo()


def got(server, path):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    connection.request("GET", path)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


REFUSED = [
    (json.dumps({"name": "x", "before": "x", "examples": [CLICK]}), {"Origin": None}),
    (json.dumps({"name": "x", "before": "x", "examples": [CLICK]}), {"Origin": "http://evil.example"}),
    (json.dumps({"name": "x", "before": "x", "examples": [CLICK]}), {"Content-Type": "text/plain"}),
    ("{", {}),
    ("[]", {}),
    (json.dumps({"name": "x", "before": "x", "examples": 3}), {}),
    (json.dumps({"name": "", "before": "", "examples": [CLICK]}), {}),
    (json.dumps({"name": "x", "before": "x", "examples": [CLICK | {"photo": "gone.jpg"}]}), {}),
    ("[" * 100_000, {}),
    ("", {}),
]
"""What pages of others post, and what no page of ours does."""


def test_others_marks_and_broken_ones_are_refused_and_change_nothing(file):
    before = file.read_bytes()
    with live(file) as server:
        for content, headers in REFUSED:
            status, told = posted(server, content, **headers)
            assert status in (400, 403) and told and "Traceback" not in told, (content[:80], headers)
            assert file.read_bytes() == before
        assert posted(server, json.dumps({"name": "x", "before": "x", "examples": []}))[0] == 200
    assert in_file(file) == {}


# ── in the browser ──────────────────────────────────────────────────────────────────────────────────────


def address_of(server):
    return f"http://127.0.0.1:{server.server_port}/"


def spot(page, scene, x, y):
    """Where the window shows a point of the wall."""
    pixel = page.evaluate("(point) => lang3dxl.view.pixel(point)", [x, y, 0])
    corner = page.locator("#frame canvas").bounding_box()
    return corner["x"] + pixel[0], corner["y"] + pixel[1]


@pytest.mark.slow
def test_a_photo_lies_exactly_over_the_rendering_and_leaves_with_the_eye(browser, file, photos):
    with live(file, photos) as server:
        page = opened(browser, address_of(server), DESK)
        page.emulate_media(reduced_motion="reduce")
        page.get_by_role("button", name=f"Photo {ALL}").click()
        page.locator("#over.there").wait_for(state="attached")
        rest(page)
        place = page.locator("#photo").bounding_box()
        corner, camera = page.locator("#frame canvas").bounding_box(), painted_scene().file.photo(ALL).camera
        for x, y in ((1, 1), (2, 2), (-2, -1)):
            at = camera.intrinsics.numpy() @ camera.view_matrix[:3].numpy() @ [x, y, 0, 1]
            expected = page.evaluate("(point) => lang3dxl.view.pixel(point)", [x, y, 0])
            assert place["x"] - corner["x"] + place["width"] * at[0] / at[2] / 96 == pytest.approx(
                expected[0], abs=1
            )
            assert place["y"] - corner["y"] + place["height"] * at[1] / at[2] / 96 == pytest.approx(
                expected[1], abs=1
            )
        page.get_by_label("Photo to the left").fill("25")
        clip = page.evaluate("document.getElementById('photo').style.clipPath")
        shown = place["width"] - float(clip.split()[1].removesuffix("px"))
        assert shown + place["x"] - corner["x"] == pytest.approx(0.25 * corner["width"], abs=1)
        until_linked(page, f"photo={ALL.replace('/', '%2F')}")
        page.evaluate("lang3dxl.view.mover.free = true")
        page.locator("#frame").press("ArrowLeft")
        page.locator("#over").wait_for(state="hidden")
        page.get_by_role("button", name="Cameras").click()
        drawn = page.evaluate(
            "document.querySelector('#pyramids .sure').getAttribute('d').split('M').length - 1"
        )
        assert drawn == 4 * 2  # four sides each, but of the photo where the eye stands
        assert page.complaints == []
        page.close()


@pytest.mark.slow
def test_a_word_taught_in_the_page_is_in_the_scenes_file_and_in_the_page(browser, file, photos):
    with live(file, photos) as server:
        page = opened(browser, address_of(server), DESK)
        scene = painted_scene()
        page.get_by_role("button", name="Teach a word").click()
        page.mouse.click(*spot(page, scene, 1.5, 1.5))
        page.get_by_text("1 example").wait_for()
        name = page.get_by_role("textbox", name="Name")
        name.fill("cupola of mine")
        name.press("Enter")
        page.get_by_text("keeps it").wait_for()
        word = in_file(file)["cupola of mine"]
        (example,) = word["examples"]
        camera = scene.file.photo(example["photo"]).full_camera
        at = camera.intrinsics.numpy() @ camera.view_matrix[:3].numpy() @ [1.5, 1.5, 0, 1]
        np.testing.assert_allclose(example["points"], [at[:2] / at[2] - 0.5], atol=3)
        page.get_by_role("button", name="Not this").click()
        page.mouse.click(*spot(page, scene, -0.8, -0.8))
        page.get_by_text("2 examples").wait_for()
        until(page, lambda: in_file(file)["cupola of mine"]["examples"] != word["examples"])
        page.get_by_role("button", name="Undo").click()
        until(page, lambda: in_file(file)["cupola of mine"], word)
        page.reload()
        page.evaluate("lang3dxl.ready.then(() => true)")
        page.get_by_role("button", name="Add", exact=True).click()
        page.get_by_role("button", name="Forget").click()
        until_told(page, "#status", "The scene forgot")
        assert in_file(file) == {} and page.complaints == []
        page.close()


def test_a_name_that_is_half_typed_stays_when_an_answer_arrives(browser, file, tmp_path):
    write_page(Page(read_scene(file, "cpu")), tmp_path / "page")
    with served(tmp_path / "page") as address:
        page = opened(browser, address, DESK)
        page.evaluate("lang3dxl.ask('dome')")
        page.evaluate("lang3dxl.ready.then(() => true)")
        page.get_by_role("button", name="Teach a word").click()
        name = page.get_by_role("textbox", name="Name")
        name.click(click_count=3)
        page.evaluate("lang3dxl.ask('sky')")  # draws all cards anew
        page.keyboard.type("giz")  # instead of the name, which is still selected
        page.evaluate("lang3dxl.ask('wall')")  # draws all cards anew
        page.keyboard.type("mo")
        assert name.input_value() == "gizmo"
        page.evaluate("lang3dxl.ask('sky')")
        named = "lang3dxl.prompts.filter(({ examples }) => examples).map(({ text }) => text)"
        assert page.evaluate(named) == ["like this 1"]  # it isn't done yet
        page.keyboard.press("Enter")
        until(page, named, ["gizmo"])
        page.close()


@pytest.mark.slow
def test_a_page_whose_server_is_gone_says_so_also_with_a_folded_panel(browser, file):
    with live(file) as server:
        page = opened(browser, address_of(server), DESK)
        page.route("**/api/**", lambda route: route.abort())
        page.get_by_role("button", name="Panel").click()
        page.evaluate("location.hash = 'ask=campanile'")
        page.get_by_text("server of this page doesn't answer").wait_for()  # Playwright waits until it is seen
        page.get_by_role("button", name="Panel").click()
        page.get_by_role("button", name="Teach a word").click()
        page.mouse.click(*spot(page, painted_scene(), 1.5, 1.5))
        page.get_by_text("1 example").wait_for()
        name = page.get_by_role("textbox", name="Name")
        name.fill("gizmo")
        name.press("Enter")
        page.get_by_text("server of this page doesn't answer").wait_for()
        page.context.unroute_all()  # all pages of these tests are in one
        page.close()


@pytest.mark.slow
def test_a_static_page_writes_words_that_the_scene_learns_as_if_marked_there(browser, file, photos, tmp_path):
    scene = read_scene(file, "cpu")
    write_page(Page(scene, photos=photos), tmp_path / "page")
    with served(tmp_path / "page") as address:
        page = opened(browser, address + "#photo=all%2F0003.jpg", DESK)
        page.emulate_media(reduced_motion="reduce")
        page.get_by_role("button", name=f"Photo {ALL}").click()
        page.locator("#over.there").wait_for(state="attached")
        page.get_by_role("button", name="Teach a word").click()
        page.get_by_role("button", name="Outline").click()
        corners = [spot(page, scene, x, y) for x, y in ((1, 1), (1, 2), (2, 2), (2, 1), (1.1, 1))]
        page.mouse.move(*corners[0])
        page.mouse.down()
        for corner in corners[1:]:
            page.mouse.move(*corner, steps=4)
        page.mouse.up()
        page.get_by_text("1 example").wait_for()
        name = page.get_by_role("textbox", name="Name")
        name.fill("gizmo")
        name.press("Enter")
        with page.expect_download() as saved:
            page.get_by_role("button", name="Save").click()
        until_linked(page, "like=gizmo")
        link = page.url
        (word,) = load_words(saved.value.path())
        (example,) = word.examples
        assert example.mask.mean() == pytest.approx((70 / 5 / 96) ** 2, rel=0.15)  # a unit of the wall
        known = scene.carrying(word)
        assert known.words["gizmo"].to_json() == scene.teach("gizmo", example).words["gizmo"].to_json()
        dome = scene.ask("dome").gaussians[0]
        assert float((known.ask("gizmo").gaussians[0] & dome).sum() / dome.sum()) > 0.8
        page.reload()
        page.evaluate("lang3dxl.ready.then(() => true)")
        told = "lang3dxl.prompts.map(({ text, matching }) => [text, matching])"
        until(page, "lang3dxl.prompts.length", 1)
        shown = page.evaluate(told)
        page.evaluate("lang3dxl.clear()")
        assert page.evaluate("lang3dxl.ask('gizmo')")["matching"] == shown[0][1]
        other = browser.new_context().new_page()  # without what this browser keeps
        other.goto(link)
        other.evaluate("lang3dxl.ready.then(() => true)")
        until(other, told, shown)
        assert shown[0][0] == "gizmo"
        other.close()
        page.close()


# ── files ───────────────────────────────────────────────────────────────────────────────────────────────


def test_photos_are_small_undistorted_and_only_where_asked_for(photos, tmp_path):
    scene = painted_scene()
    assert not [name for name in Page(scene).files() if name.endswith(".jpg")]
    page = Page(scene, photos=photos)
    files = page.files()
    cameras = json.loads(files["scene.json"])["cameras"]
    assert [camera["name"] for camera in cameras] == [p.name for p in scene.photos if p.split == "train"]
    assert all(files[camera["photo"]][:2] == b"\xff\xd8" for camera in cameras) and PHOTO_SIDE <= 1024
    with pytest.raises(UserError, match="name the folder that the scene was made from"):
        small_photo(scene.photos[0], tmp_path)
    write_page(page, tmp_path / "page")
    (tmp_path / "page" / "photo77.jpg").write_text("mine")
    write_page(Page(scene), tmp_path / "page")  # the photos of an earlier page don't stay public
    assert [path.name for path in (tmp_path / "page").glob("*.jpg")] == ["photo77.jpg"]


def test_what_is_large_and_floats_before_the_wall_is_hidden_and_left_out(tmp_path):
    scene = painted_scene()
    means, scales = scene.splats.means.clone(), scene.splats.scales.clone()
    opacities = scene.splats.opacities.clone()
    middle = torch.cartesian_prod(torch.linspace(-1, 1, 5), torch.linspace(-1, 1, 4))
    means[:20], scales[:20], opacities[:20] = torch.nn.functional.pad(middle, (0, 1), value=-2.0), 0.4, 0.1
    scales[20::200], opacities[20::200] = 0.4, 0.1  # as large, on the wall
    scene = painted_scene(splats=replace(scene.splats, means=means, scales=scales, opacities=opacities))
    floats = scene.floating > FLOATS
    assert floats[:20].float().mean() > 0.8 and not floats[20:].any()
    packed = np.frombuffer(Page(scene).files()["floaters.bin"], np.uint8)
    np.testing.assert_array_equal(packed > 255 * FLOATS, floats.numpy())
    count = scene.export(tmp_path / "scene.ply", hide_floaters=True)
    assert count == int((~floats).sum()) < scene.export(tmp_path / "all.ply")


@pytest.mark.slow
def test_a_misspelled_word_is_offered_where_the_answer_is_not_sure(browser, file):
    with live(file) as server:
        page = opened(browser, address_of(server), DESK)
        page.evaluate("lang3dxl.ask('windwos')")
        until_told(page, "#near", "Did you mean windows?")
        page.locator("#near").get_by_role("button", name="windows", exact=True).click()
        page.locator("#prompts strong", has_text="windows").wait_for()
        until(page, "lang3dxl.prompts.map(({ text }) => text).join()", "windows")
        until(page, "document.getElementById('near').textContent", "")
        assert page.complaints == []
        page.close()
