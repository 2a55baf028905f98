"""The files of a page, as they are written."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from pages import field_scene
from painted_scene import painted_file, painted_looks, painted_scene, painted_splats

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import read_names
from lang3dxl_ns.query.text import NO_SEMANTICS, NOT_FINISHED
from lang3dxl_ns.query.vocabulary import common_words, searched, shipped_vocabulary, whole_words
from lang3dxl_ns.web.photos import extent
from lang3dxl_ns.web.write_page import _DATA, Page, write_page


def test_a_page_of_other_people_is_not_replaced(scene, tmp_path):
    for name in ("index.html", "scene.json", "page.css", "views.bin", "vocabulary.json", "photo.JPG"):
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_text("mine")
        with pytest.raises(UserError, match=rf"holds {name}, which is not a scene's page"):
            write_page(Page(scene), folder)
        assert [path.read_text() for path in folder.iterdir()] == ["mine"]
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "CNAME").write_text("mine")
    (own := tmp_path / "own" / "model.bin").parent.mkdir(exist_ok=True)
    write_page(Page(scene), own.parent)
    before = set(json.loads((own.parent / "scene.json").read_text())["files"].values())
    own.write_text("mine")
    write_page(Page(scene, more=["zoo"]), own.parent)  # without what is left of the page before
    after = set(json.loads((own.parent / "scene.json").read_text())["files"].values())
    left = {path.name for path in own.parent.iterdir()}
    assert before - after and not (before - after) & left and after <= left
    assert all(_DATA.fullmatch(name) for name in before)  # or it would stay for ever
    assert {"CNAME", "model.bin"} <= left


def test_a_page_whose_writing_was_stopped_is_written_again(scene, tmp_path, monkeypatch):
    written = []

    def stop(path, content):
        written.append(path)
        if len(written) == 2:
            raise KeyboardInterrupt
        path.write_bytes(content)

    with monkeypatch.context() as patched:
        patched.setattr("lang3dxl_ns.web.write_page.replace_file", stop)
        with pytest.raises(KeyboardInterrupt):
            write_page(Page(scene), tmp_path)
    assert write_page(Page(scene), tmp_path) == sum(path.stat().st_size for path in tmp_path.iterdir())


def test_a_page_is_complete_and_small(scene):
    files = Page(scene, ["dome; window"]).files()
    own = {name for name in files if name.endswith((".html", ".css", ".js", ".txt", "spark.bin"))}
    assert {
        "index.html",
        "page.css",
        "page.js",
        "worker.js",
        "library.js",
        "spark.bin",
        "LICENSES.txt",
    } <= own
    assert sum(len(files[name]) for name in own) < 1.4e6
    licenses = files["LICENSES.txt"].decode()
    assert all(name in licenses for name in ("three 0", "spark 2", "fflate 0", "MIT License"))
    assert json.loads(files["scene.json"])["prompts"] == [["dome"], ["window"]]


def test_all_views_are_in_a_page_and_what_is_left_out_is_told(monkeypatch, scene):
    page = Page(scene)
    files = page.files()
    names = [view["name"] for view in json.loads(files["scene.json"])["views"]]
    assert names == list(scene.visible) and page.left_out == []
    monkeypatch.setattr("lang3dxl_ns.web.write_page._MOST_BYTES", len(files["views.bin"]) - 1)
    smaller = page.files()
    about = json.loads(smaller["scene.json"])
    assert 0 < len(about["views"]) < len(names) and len(smaller["views.bin"]) < len(files["views.bin"])
    assert about["left_out"] == page.left_out == ["1 of 3 views are left out, to load quickly"]


def test_lightings_are_files_of_a_page_or_answers_of_a_server(monkeypatch):
    scene = painted_scene(looks=painted_looks())
    static, live = Page(scene), Page(scene, live=True)
    files = static.files()
    offered = json.loads(files["scene.json"])["looks"]
    assert list(offered) == scene.looks.names
    for name, file in offered.items():
        assert files[file] == live.colors(name) and len(files[file]) == 4 * len(scene.splats)
    assert len(set(map(files.get, offered.values()))) > 1
    assert json.loads(live.files()["scene.json"])["looks"]["all/0003.jpg"] == "api/look?photo=all/0003.jpg"
    monkeypatch.setattr("lang3dxl_ns.web.write_page._MOST_BYTES", 4 * len(scene.splats))
    assert len(json.loads(static.files()["scene.json"])["looks"]) == 1
    assert any("lightings are left out" in told for told in static.left_out)


def test_a_field_takes_eight_bytes_a_gaussian():
    scene = field_scene(3)
    files = Page(scene).files()
    assert len(files["codes.bin"]) == 8 * len(scene.splats) and "rows.bin" not in files
    assert len(files["splats.bin"]) == 16 * len(scene.splats)


def test_a_decoder_too_wide_for_a_page_is_refused_in_a_sentence(monkeypatch, scene):
    monkeypatch.setattr("lang3dxl_ns.web.pack._MOST_ROW_BYTES", 1000)
    with pytest.raises(UserError, match="preset `short`"):
        Page(scene)


@pytest.mark.parametrize(("clip", "why"), [(None, NO_SEMANTICS), ("clip", NOT_FINISHED)])
def test_a_scene_without_words_makes_a_page_that_says_why_it_cant_be_asked(clip, why):
    bare = painted_scene(file=replace(painted_file(), clip=clip), decoder=None, codes=None)
    told = json.loads(Page(bare).files()["scene.json"])
    assert (told["words"], told["wordless"]) == (None, why)
    with pytest.raises(UserError, match=re.escape(why)):
        Page(bare, ["dome"])


def test_broken_gaussians_keep_their_rows(scene):
    splats = painted_splats()
    means = splats.means.clone()
    means[7] = torch.nan
    broken = painted_scene(splats=replace(splats, means=means))
    packed = np.frombuffer(Page(broken).files()["splats.bin"], np.uint8).reshape(-1, 16)
    whole = np.frombuffer(Page(scene).files()["splats.bin"], np.uint8).reshape(-1, 16)
    assert packed[7, 3] == 0 and len(packed) == len(whole)


def test_the_words_of_a_tokenizer_are_whole_and_plain(tmp_path):
    words = whole_words("builtin")
    assert len(words) > 200 and {"window", "windows"} & set(words)
    assert all(word.isalpha() and word.islower() and len(word) >= 3 for word in words)
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "model.safetensors").write_bytes(b"")
    unigram = [["▁tower", -1.0], ["tower", -2.0], ["▁to", -3.0], ["▁Tow", -1.0]]
    (tmp_path / "tokenizer.json").write_text(json.dumps({"model": {"vocab": unigram}}))
    assert whole_words(tmp_path) == ("tower",)


def test_plurals_have_no_plural():
    words = {*common_words()}
    assert {"windows", "arches", "columns", "domes", "buses"} <= words
    assert not {"windowses", "archeses", "columnses", "pillarses"} & words


def test_a_vocabulary_of_ones_own_is_offered_and_named(tmp_path):
    (tmp_path / "words.txt").write_text("belfry\n\n  zebra crossing \nbelfry\n")
    assert read_names(tmp_path / "words.txt", "words") == ("belfry", "zebra crossing")
    with pytest.raises(UserError, match="list of words"):
        read_names(tmp_path / "missing.txt", "words")
    described = json.loads(
        Page(painted_scene(), words=["lych gate"], more=["porch", "zoo"]).files()["vocabulary.json"]
    )
    assert described["words"][: described["naming"]] == [*shipped_vocabulary(), "lych gate"]


def test_words_of_a_tokenizer_are_searched_for_as_in_python_and_split_as_in_python():
    page = Page(painted_scene(), more=["haus", "and", "not", "rose garden"])
    files = page.files()
    described, about = (json.loads(files[name]) for name in ("vocabulary.json", "scene.json"))
    assert about["names"] == ["rose garden"]  # "windows and doors" are two
    renamed = {i: word for i, word in enumerate(described["words"]) if searched(word) != word}
    assert {"haus", "upper windows"} <= {*renamed.values()}
    numbers = np.frombuffer(files["vocabulary.bin"], "<f2").reshape(-1, about["words"]["width"])
    for i, word in renamed.items():
        rows, against = described["special"][str(i)]
        near, rivals = page._meant(page._meaning, word)
        assert against == rivals and len(rows) == len(near)
        np.testing.assert_allclose(numbers[rows], near.numpy(), atol=2e-3)


def test_a_scene_that_is_wider_than_half_precision_is_refused_and_a_stray_gaussian_is_not():
    splats = painted_splats()
    means = splats.means.clone()
    means[0, 0] = 1e6
    stray = Page(painted_scene(splats=replace(splats, means=means))).files()["splats.bin"]
    packed = np.frombuffer(stray, np.uint8).reshape(-1, 16)
    assert np.isfinite(packed[:, 4:10].copy().view("<f2")).all()
    wide = replace(splats, means=1e5 * splats.means, scales=1e5 * splats.scales)
    with pytest.raises(UserError, match="make the splat smaller"):
        Page(painted_scene(splats=wide)).files()


def test_an_overview_reaches_a_spire_and_not_the_sky(scene):
    camera = scene.overview.full_camera
    left, top, right, bottom, _ = extent(scene)
    draw, view = torch.Generator().manual_seed(0), camera.view_matrix

    def overview(places, sizes, mass):
        means = (torch.tensor(places) - view[:3, 3]) @ view[:3, :3]
        scales = torch.tensor(sizes)[:, None].expand(-1, 3)
        splats = replace(
            scene.splats.select(torch.arange(len(means)) % len(scene.splats)),
            means=means.float(),
            scales=scales,
        )
        return extent(SimpleNamespace(overview=scene.overview, splats=splats, mass=torch.tensor(mass)))

    spread = torch.rand(2000, 2, generator=draw) * torch.tensor([right - left, bottom - top])
    walls = [[5 * (left + x), 5 * (top + y), 5.0] for x, y in spread.tolist()]
    spire = [[0.0, 5 * top * (1 + 0.005 * k), 5.0] for k in range(41)]  # up to 1.2 times as high
    sky = [[40 * x - 20, -30 * y, 6.0] for x, y in torch.rand(300, 2, generator=draw).tolist()]
    building, whole = [*walls, *spire], [*walls, *spire, *sky]
    plain = overview(building, [0.03] * len(building), [1.0] * len(building))
    assert plain[1] == pytest.approx(1.06 * 1.2 * top, rel=0.02)
    assert [plain[0], *plain[2:4]] == pytest.approx([left, right, bottom], rel=0.1)
    thin = overview(building, [0.03] * len(building), [1.0] * len(walls) + [0.05] * len(spire))
    assert thin[1] < 1.06 * 1.1 * top  # a needle, a thousandth of what photos show
    under_sky = overview(whole, [0.03] * len(building) + [2.0] * 300, [1.0] * len(building) + [1e3] * 300)
    assert under_sky == pytest.approx(plain)
