"""`lang3dxl query` and `export`, on a scene whose answers are known."""

import json
import os

import numpy as np
import pytest
from painted_scene import COUNT, painted_gaussians, painted_scene
from PIL import Image

from lang3dxl_ns import cli
from lang3dxl_ns.commands import export, query
from lang3dxl_ns.commands.query import file_names
from lang3dxl_ns.common.files import slugs
from lang3dxl_ns.files.scene_file import Provenance
from lang3dxl_ns.scene.photo_folder import photos_below


@pytest.fixture
def run(monkeypatch):
    """Runs a command on the painted scene."""
    for command in (query, export):
        monkeypatch.setattr(
            command, "load_scene", lambda path, settings=None, clip=None: painted_scene(config=settings)
        )
    return lambda *words: cli.main([str(word) for word in words])


@pytest.mark.parametrize("name", ["wall.scene", "labels", "folder.json"])
def test_labels_are_written_to_a_json_file_alone(run, tmp_path, name):
    (tmp_path / "wall.scene").write_text("a scene")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(SystemExit, match=r"is not the name of a \.json file"):
        run("query", "c", "--text", "dome", "--all", "--out", tmp_path / "o", "--coco", tmp_path / name)
    assert (tmp_path / "wall.scene").read_text() == "a scene" and not (tmp_path / "o").exists()


def test_labels_replace_own_labels_alone(run, tmp_path):
    drawn = '{"info": {"description": "by hand"}, "images": [], "annotations": []}'
    words = ("query", "c", "--text", "dome", "--all", "--out", tmp_path / "o", "--coco", tmp_path / "a.json")
    for content in ('{"name": "my package"}', "[]", "no JSON", drawn):
        (tmp_path / "a.json").write_text(content)
        with pytest.raises(SystemExit, match="would be replaced, and is not ours"):
            run(*words)
        assert (tmp_path / "a.json").read_text() == content
    (tmp_path / "a.json").unlink()
    run(*words)
    run(*words)
    assert len(json.loads((tmp_path / "a.json").read_text())["images"]) == len(painted_scene().photos)


def test_query_writes_pictures_map_and_report(run, tmp_path, capsys):
    words = ("query", "c", "--text", 'dome not "window"', "--text", "window;oculus")
    run(*words, "--image", "all/0003.jpg", "--out", tmp_path)
    report = json.loads((tmp_path / "query.json").read_text())
    assert report["texts"][0]["threshold"] == 0.5 and 0 < report["texts"][1]["threshold"] < 0.5
    assert [t["text"] for t in report["texts"]] == ["dome", "window", "oculus"]
    assert (
        report["texts"][0]["negatives"] == ["window"] and report["texts"][2]["synonyms"][0] == "round window"
    )
    view = report["views"][0]
    assert view["view"] == "all_0003" and view["render_seconds"] >= 0 and view["query_seconds"] > 0
    relevancy = np.load(tmp_path / "dome" / "all_0003.npy")
    assert relevancy.shape == (96, 96) and relevancy.dtype == np.float32
    column, row = view["matches"][0]["peak"]
    assert relevancy[row, column] == relevancy.max() == pytest.approx(view["matches"][0]["score"])
    mask = np.asarray(Image.open(tmp_path / "dome" / "all_0003.mask.png"))
    match = painted_scene().query('dome not "window"', "all/0003.jpg")
    np.testing.assert_array_equal(mask == 255, match.mask)
    picture = np.asarray(Image.open(tmp_path / "dome" / "all_0003.overlay.png")).astype(int)
    assert (np.ptp(picture[mask == 0], axis=1) == 0).all() and (
        np.ptp(picture[mask == 255], axis=1) > 0
    ).all()
    assert "dome" in capsys.readouterr().out


def test_answers_are_no_photos(run, tmp_path):
    """They lie among photos if someone asks in the folder of the photos, as training proposes."""
    (tmp_path / "windows").mkdir()
    for name in ("a.png", "windows/b.mask.png", "windows/photo1.jpg"):
        Image.new("RGB", (90, 90)).save(tmp_path / name)
    before = photos_below(tmp_path)
    run("query", "c", "--text", "dome", "windows", "--out", tmp_path / "found", "--all")
    for mark, picture in (("page/page.js", "page/photo0.jpg"), ("list/things.json", "list/things.png")):
        (tmp_path / mark).parent.mkdir()
        (tmp_path / mark).touch()
        Image.new("RGB", (90, 90)).save(tmp_path / picture)
    assert list((tmp_path / "found").glob("together/*.png")) and len(before) == 3
    assert photos_below(tmp_path) == before


def test_a_text_that_is_given_twice_is_asked_once(run, tmp_path):
    run(
        "query", "c", *("--text", "dome;dome", "--text", "dome"), "--image", "all/0003.jpg", "--out", tmp_path
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dome", "query.json"]


def test_files_of_an_earlier_query_stay_and_are_told(run, tmp_path, capsys):
    photo = ("--image", "all/0003.jpg", "--out", tmp_path)
    (tmp_path / "holidays").mkdir()
    (tmp_path / "holidays" / "list.txt").write_text("no file of a query")
    run("query", "c", "--text", "dome; window", *photo)
    os.utime(tmp_path / "query.json", times=(4e9, 4e9))  # the clock went back since
    run("query", "c", "--text", "dome; window", *photo)
    assert "earlier query" not in capsys.readouterr().out
    run("query", "c", "--text", "dome", *photo)
    assert "files of an earlier query, not listed in query.json: together, window" in capsys.readouterr().out
    assert (tmp_path / "window" / "all_0003.npy").is_file()


def test_all_photos_are_asked(run, tmp_path):
    run("query", "c", "--text", "dome", "--all", "--out", tmp_path)
    assert len(list((tmp_path / "dome").glob("*.npy"))) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--text", " ; "), "the prompt is empty"),
        ((), "there is no --text"),
        (("--text", "dome", "--image", "x"), "no photo 'x'"),
        (("--text", "wall; dome", "--not", "Dome"), "'dome' is its own negative"),
        (("--text", "dome", "--image", "0001", "--all"), "exclude each other"),
    ],
)
def test_mistakes_end_in_a_sentence(run, tmp_path, words, message):
    with pytest.raises(SystemExit, match=message):
        run("query", "c", "--out", tmp_path, *words)


def test_settings_are_flags(run, tmp_path):
    words = ("query", "c", "--text", "dome", "--image", "0002", "--out", tmp_path)
    run(*words, "--threshold", 1, "--synonyms", "off")
    assert not np.asarray(Image.open(tmp_path / "dome" / "right_0002.mask.png")).any()


@pytest.mark.parametrize(
    ("target", "option"),
    [("--scene-file", "--text"), ("--scene-file", "--not"), ("--out", "--title"), ("--out", "--vocabulary")],
)
def test_export_refuses_options_without_effect(run, tmp_path, target, option):
    name = {"--out": "a.ply", "--scene-file": "a.scene"}[target]
    with pytest.raises(SystemExit, match=f"{option} has no effect on {target}"):
        run("export", "c", target, tmp_path / name, option, "dome")


@pytest.mark.parametrize(
    ("option", "name", "message"),
    [
        (("--all",), "a.spz", r"a\.spz can't hold relevancies: write a \.ply"),
        (("--size", 300), "a.ply", "--size is that of pictures"),
    ],
)
def test_export_refuses_what_its_file_cant_hold(run, tmp_path, option, name, message):
    with pytest.raises(SystemExit, match=message):
        run("export", "c", "--text", "dome", "--out", tmp_path / name, *option)
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize("target", ["--scene-file", "--out"])
@pytest.mark.parametrize("option", [("--threshold", 0.9), ("--size", 300), ("--synonyms", "off")])
def test_export_refuses_settings_of_queries_without_a_text(run, tmp_path, target, option):
    name = {"--out": "a.ply", "--scene-file": "a.scene"}[target]
    give = ", or give one$" if target == "--out" else "$"  # which a scene file refuses
    with pytest.raises(
        SystemExit, match=f"settings of queries have no effect without --text: leave them off{give}"
    ):
        run("export", "c", target, tmp_path / name, *option)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("view", "c", "--photos", "nowhere"), "nowhere is not a folder"),
        (("export", "c", "--web", "page", "--photos", "nowhere"), "nowhere is not a folder"),
        (("view", "c", "--tour", "--text", "windows"), "in place of --text: leave one off"),
    ],
)
def test_mistakes_are_told_before_the_scene_loads(run, monkeypatch, words, message):
    monkeypatch.setattr("lang3dxl_ns.open_scene.load_scene", None)
    monkeypatch.setattr("lang3dxl_ns.commands.export.load_scene", None)
    with pytest.raises(SystemExit, match=message):
        run(*words)


def test_a_film_has_a_use_for_settings_of_queries(run, monkeypatch, tmp_path):
    monkeypatch.setattr(export, "provenance_of", lambda _: Provenance())
    with pytest.raises(SystemExit, match="there is no tour"):  # after all options are accepted
        run("export", "c", "--video", tmp_path / "a.mp4", "--foreground", "wall")


def test_export_writes_the_matching_gaussians_or_all_with_scores(run, tmp_path):
    run("export", "c", "--text", "dome", "--out", tmp_path / "dome.ply")
    domes = int((painted_gaussians()["words"] == 1).sum())
    assert f"element vertex {domes}\n".encode() in (tmp_path / "dome.ply").read_bytes()
    run("export", "c", "--text", "dome", "--all", "--out", tmp_path / "all.ply")
    content = (tmp_path / "all.ply").read_bytes()
    assert f"element vertex {COUNT}\n".encode() in content and b"property float relevancy\n" in content
    with pytest.raises(SystemExit, match="no Gaussian matches 'palm tree'"):
        run("export", "c", "--text", "palm tree", "--out", tmp_path / "none.ply")


def test_folder_names_are_safe_and_differ():
    texts = ["Rose window", "rose-window", "🙂", "../../etc", "окно", "x" * 500]
    names = slugs(texts)
    assert names == ["rose-window", "rose-window-2", "text-3", "etc", "окно", "x" * 40]


def test_photos_of_one_stem_do_not_overwrite_each_other():
    assert file_names(["a/b.jpg", "c.jpg"]) == ["a_b", "c"]
    assert file_names(["a.jpg", "a.png", "../c.d.jpg"]) == ["a_jpg", "a_png", ".._c.d"]
    names = file_names(["a/b.jpg", "a_b.jpg", "a/b.png"])
    assert len(set(names)) == 3


def test_each_text_gets_its_own_best_view(run, tmp_path):
    run("query", "c", "--text", "dome; window", "--out", tmp_path)
    assert [path.name for path in (tmp_path / "dome").glob("*.npy")] == ["right_0002.npy"]
    assert [path.name for path in (tmp_path / "window").glob("*.npy")] == ["left_0001.npy"]
    assert not (tmp_path / "together").exists()


def test_a_view_of_several_texts_is_also_one_picture(run, tmp_path):
    run("query", "c", "--text", "dome; window", "--image", "0003", "--size", 200, "--out", tmp_path)
    picture = np.asarray(Image.open(tmp_path / "together" / "all_0003.png"))
    assert picture.shape[1] == 200 and picture.shape[0] > 200  # and a legend
    assert np.load(tmp_path / "dome" / "all_0003.npy").shape == (200, 200)


def test_a_text_that_nothing_matches_says_so(run, tmp_path, capsys):
    run("query", "c", "--text", "palm tree", "--out", tmp_path)
    assert "no match; this view comes closest" in capsys.readouterr().out
