"""Wrong commands and calls end in one line that says what to do: those that no other test provokes."""

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
import torch
from painted_scene import painted_scene
from PIL import Image

from lang3dxl_ns.cli import main
from lang3dxl_ns.common.device import known_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import data_option, model_option, switched_on
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.query.match import together
from lang3dxl_ns.query.text import Prompt, caution, parse_prompts
from lang3dxl_ns.things.grammar import parse


def report(path: Path, scene: str, layout: str = "plain", scored: bool = True) -> None:
    """A report of `lang3dxl evaluate`, as short as it can be."""
    results = {"photos": {}, "protocol": {"layout": layout, "scored_at": 0.5}} | (
        {"map": 0.5} if scored else {}
    )
    path.write_text(json.dumps({"scene": scene, "results": results}))


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Where the commands below find what they name."""
    (tmp_path / "label" / "dome").mkdir(parents=True)
    Image.fromarray(np.full((8, 8), 255, np.uint8)).save(tmp_path / "label" / "dome" / "0001.png")
    (tmp_path / "maps" / "dome").mkdir(parents=True)
    np.save(tmp_path / "maps" / "dome" / "0001.npy", np.full((8, 8), np.nan))
    report(tmp_path / "a.json", "a")
    report(tmp_path / "b.json", "b", layout="holyscenes")
    report(tmp_path / "c.json", "c", scored=False)
    (tmp_path / "silent.json").write_text(
        json.dumps({"scene": "d", "results": {"photos": {}, "protocol": 3}})
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


MAPS = "evaluate maps --maps maps --ground-truth label --out report"
COMMANDS = {
    f"{MAPS} --temperature 0": "--temperature is 0.0: give a number above 0",
    MAPS: "holds NaN or infinity: fix the program that made it",
    "evaluate pool --out report --reports": "name the scenes' reports after --reports",
    "evaluate pool --out report --reports a.json b.json": "the scenes differ in layout",
    "evaluate pool --out report --reports c.json": "no prompt was scored in c",
    "evaluate pool --out report --reports silent.json": "it does not say what was scored",
    "evaluate pool --out report --reports none.json": "there is no none.json",
    "export": "give one of --out FILE.ply, --web FOLDER",
    "export --out a.ply --text dome --text tower": "a splat file holds one --text",
    "doctor --build": "name a compute capability, such as --arch 8.6",
    "benchmark gpu --out report": "lang3dxl doctor says why",
    "demo-scene --out s --photos 2": "--photos is 2",
    "demo-scene --out s --test-views -1": "--test-views is -1",
    "demo-scene --out s --seed -1": "--seed is -1",
    "query none --text dome --out found": "none",
}


@pytest.mark.parametrize("words", COMMANDS)
def test_commands(words, folder, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    before = set(folder.rglob("*"))
    with pytest.raises(SystemExit) as end:
        main(words.split())
    (line,) = str(end.value).splitlines()
    assert line.startswith("Error: ") and COMMANDS[words] in line
    assert not [path for path in set(folder.rglob("*")) - before if path.is_file()]


def holyscenes(folder: Path) -> None:
    (folder / "domes").mkdir()
    for name in ("0001-gt.jpg", "0002-img.jpg"):
        Image.fromarray(np.zeros((8, 8), np.uint8)).save(folder / "domes" / name)


def lerf_ovs(width: object = 8, outline: object = ((0, 0), (4, 0), (4, 4))) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        item = {"category": "dome", "bbox": [0, 0, 4, 4], "segmentation": outline}
        info = {"name": "frame_1.jpg", "width": width, "height": 8}
        (folder / "frame_1.json").write_text(json.dumps({"info": info, "objects": [item]}))

    return write


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (holyscenes, "but no .*0002-gt.jpg: add the mask, or remove the photo"),
        (lerf_ovs(width=0), "a photo of 0 × 8 pixels.*fix or remove the file"),
        (lerf_ovs(outline=[[0, 0], [4, 0]]), "has 2 points, but needs three"),
    ],
)
def test_ground_truth(write, message, tmp_path):
    write(tmp_path)
    with pytest.raises(UserError, match=message):
        _ = GroundTruth(tmp_path).categories


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda scene: scene.query("dome", threshold=1.5), "give a relevancy from 0 to 1"),
        (lambda scene: scene.relevancy("dome; window"), "ask for one at a time"),
        (lambda scene: scene.query('not "dome"'), "put what to find first"),
        (lambda scene: scene.query("dome").save("dome.txt"), "use .png or .jpg"),
        (lambda scene: together([]), "pass the matches of a single query"),
        (lambda scene: scene.render(np.eye(3)), r"a pose has shape \[3, 4\] or \[4, 4\]"),
        (lambda scene: scene.render("none.jpg"), "none.jpg"),
        (lambda scene: scene.render(np.full((3, 4), np.nan)), "a pose is not three rows of four numbers"),
        (lambda scene: scene.render(np.zeros((3, 4))), "a pose is not a rotation and a position"),
    ],
)
def test_python(wrong, message):
    with pytest.raises(UserError, match=message):
        wrong(painted_scene())


def test_pictures_larger_than_the_memory_are_told_with_what_fits(monkeypatch):
    scene = painted_scene()
    monkeypatch.setattr("lang3dxl_ns.scene.camera.machine_memory", lambda: 2e6)
    assert scene.camera(scene.photos[0].name, size=100).width <= 100
    with pytest.raises(UserError, match=r"takes about .* GB, .*: give at most [1-9]\d* pixels"):
        scene.camera(scene.photos[0].name, size=5_000)


@pytest.mark.parametrize("value", ["[1]", "{}", '"a"', "1e999", "1" + "0" * 400, "true", "null", "[" * 9000])
def test_pooled_figures_that_are_no_numbers(value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = '{"scene": "a", "results": {"protocol": {}, "photos": {"p": {"ap_x": VALUE}}}}'
    (tmp_path / "a.json").write_text(text.replace("VALUE", value))
    with pytest.raises(SystemExit, match=r"a\.json is not a report"):
        main(["evaluate", "pool", "--reports", "a.json", "--out", "report"])


@pytest.mark.nerfstudio
def test_ground_truth_that_is_no_folder():
    with pytest.raises(SystemExit, match="nope is not a folder"):
        main(["evaluate", "run", "none", "--ground-truth", "nope", "--out", "report"])


@pytest.mark.parametrize("text", [3, b"dome", None, float("nan")])
def test_prompts_that_are_no_text_are_type_errors_that_say_so(text):
    with pytest.raises(TypeError, match="a prompt is a text"):
        parse_prompts(text)


@pytest.mark.parametrize("value", [3, b"dome", None, float("nan"), object(), ["dome", 3], Path("dome")])
def test_python_calls_with_anything_else_name_what_was_expected(value):
    scene = painted_scene()
    name = scene.photos[0].name
    one = value if isinstance(value, list) else [value]
    for ask in (
        lambda: scene.query(value, name),
        lambda: scene.find(value),
        lambda: scene.ask("dome", negatives=one),
        lambda: scene.encode(value),
        lambda: scene.what_is(name, 5, 5, words=one),
        lambda: Prompt(value),
    ):
        with pytest.raises(TypeError, match="is a text, not "):
            ask()
    for look in (scene.render, scene.camera, lambda place: scene.what_is(place, 5, 5)):
        with pytest.raises((TypeError, UserError), match=r"a place is a photo's name|a pose has shape"):
            look(value)
    assert scene.what_is(name, 5, 5, most=-1) == []
    assert scene.ask("dome", negatives="door").prompts[0].negatives == ("door",)
    assert len(scene.encode([])) == 0
    assert len(scene.encode("dome\ud800")) == len(scene.encode("dome"))


@pytest.mark.parametrize(
    "typed", ["a" + " " * 32_000 + "b", "not" * 20_000, '"' * 30_001, "‘" * 30_000 + "b"]
)
def test_long_prompts_are_parsed_in_a_moment(typed):
    """Quadratic patterns took 40 s for the first of these, whose single spaces are one."""
    assert len(parse_prompts(typed + "x")) == 1


@pytest.mark.parametrize("part", ["?", ". ", "\N{NO-BREAK SPACE}", " on the left", " above the portal", "1"])
def test_long_questions_are_read_or_refused_in_a_moment(part):
    """Quadratic patterns took 60 s, and relations within relations ended in Python's RecursionError."""
    typed, start = "the 1" + 30_000 * part + "st window from the left", perf_counter()
    caution(typed)
    with suppress(UserError):
        parse(typed)
    assert perf_counter() - start < 5


def test_pictures_of_views_through_other_lenses_are_not_drawn_over_each_other():
    scene = painted_scene()
    place = scene.camera("0003", 48)
    wider = replace(place, intrinsics=place.intrinsics * torch.tensor([[0.5], [0.5], [1.0]]))
    matches = [scene.query("dome", camera) for camera in (place, wider)]
    with pytest.raises(UserError, match="one picture shows the prompts of one view"):
        together(matches)
    assert together([matches[0], scene.query("window", place)]).shape[1] == 48


@pytest.mark.parametrize("device", ["nodev", -1, "mps", "cuda", "cuda:77"])
def test_a_device_that_is_not_there_is_told(device, tmp_path):
    if device == "cuda" and torch.cuda.is_available():
        pytest.skip("it is there")
    with pytest.raises(UserError, match=r"give cpu|this machine has"):
        known_device(device)
    assert known_device("cpu") == torch.device("cpu")


@pytest.mark.parametrize(
    ("command", "clip", "gaussians"),
    [
        ("/usr/bin/ns-train", "--pipeline.datamanager.clip", "--pipeline.model.max-gaussians"),
        ("/x/nerfstudio/scripts/train.py", "--pipeline.datamanager.clip", "--pipeline.model.max-gaussians"),
        ("/usr/bin/lang3dxl", "--clip", "--max-gaussians"),
        ("/home/a/nerfstudio/.venv/bin/lang3dxl", "--clip", "--max-gaussians"),
        ("", "--clip", "--max-gaussians"),
    ],
)
def test_messages_spell_options_as_the_command_that_runs_has_them(command, clip, gaussians, monkeypatch):
    monkeypatch.setattr("sys.argv", [command])
    assert data_option("clip") == clip and model_option("max-gaussians") == gaussians
    theirs = clip != "--clip"
    assert model_option("appearance.use") == ("--pipeline.model.appearance.use" if theirs else "--looks")
    assert switched_on("--random-init") == ("--random-init True" if theirs else "--random-init")
