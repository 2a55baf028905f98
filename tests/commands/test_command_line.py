"""Mistakes on the command line, and what a terminal can do: hints at once, never a traceback."""

import io
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from lab.landmark.demo import Demo
from lang3dxl_ns import cli
from lang3dxl_ns.commands.query import file_names
from lang3dxl_ns.common.console import accept_any_console
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded


def shell(line: str, **environment: str) -> subprocess.CompletedProcess:
    words = f"{sys.executable} -m lang3dxl_ns.cli {line}"
    return subprocess.run(
        ["bash", "-c", words], capture_output=True, env={**os.environ, **environment}, timeout=120
    )


def test_the_version_is_told(capsys):
    cli.main(["--version"])
    assert capsys.readouterr().out[0].isdigit()


def test_without_words_the_help_is_shown(capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main([])
    assert "query" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["qeury"], "did you mean query"),
        (["benchmark", "ablatoin"], "did you mean ablation"),
        (["xyzzy"], "--help lists all"),
        (["query", "none", "--out", "found"], "there is no --text"),
        (["query", "none", "--text", " ; ", "--out", "found"], "the prompt is empty"),
        (["prepare", "--data", "nowhere", "--clip", "nobody/nothing"], "nowhere is not a folder"),
        pytest.param(
            ["prepare", "--data", ".", "--crop-batch", "0", "--clip", "builtin"],
            "--crop-batch is 0",
            marks=pytest.mark.nerfstudio,
        ),
        (["demo", "--photos", "0"], "--photos is 0"),
        (["demo", "--steps", "-5"], "--steps is -5"),
        (["view", "none", "--port", "99999"], "the port is 99999"),
        (["view", "none", "--port", "-1"], "the port is -1"),
        (["view", "none", "--host", "no.such.host.invalid"], "is not an address of this machine"),
        (["view", "none", "--host", "192.0.2.1"], "is not an address of this machine"),
        (["view", "none", "--host", "a" * 70], "is not an address of this machine"),
        (["query", "~nosuchuser/run", "--text", "a", "--out", "found"], "no such user"),
        (["demo-scene", "--out", "~nosuchuser/scene"], "no such user"),
        (["prepare", "--data", __file__], r"test_command_line\.py is neither a folder"),
    ],
)
def test_mistakes_are_told_with_the_remedy(words, hint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=hint):
        cli.main(words)


def test_a_home_in_an_option_is_no_folder_called_tilde(tmp_path, monkeypatch):
    """Shells leave the ~ of --out=~/x as it is."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="none"):
        cli.main(["query", "none", "--text", "dome", "--out=~/found"])
    assert [path.name for path in tmp_path.iterdir()] == ["home"]


def test_a_text_without_its_flag_is_told(capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(["query", "run", "windows", "--out", "found"])
    assert "Texts follow --text" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        cli.main(["query", "run", "--text", "windows", "--things"])
    assert "lang3dxl things RUN" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "before"),
    [
        (["train", ""], "train"),
        (["export", "a.scene", "--web", "", "--title", "x"], "--web"),
        (["export", "a.scene", "--web="], "--web"),
    ],
)
def test_a_variable_that_is_not_set_is_not_the_current_folder(words, before, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=f"what follows {before} is empty"):
        cli.main(words)
    with pytest.raises(UserError, match="a path is empty"):
        expanded("")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("flag", ["--text", "--ask", "--not"])
def test_several_texts_may_follow_their_flag_and_the_scene_too(flag, tmp_path):
    scene = str(tmp_path)
    assert cli.with_all_texts(["query", flag, "windows", "red roof", scene, "--out", "x"]) == (
        ["query", flag, "windows", flag, "red roof", scene, "--out", "x"]
    )
    assert cli.with_all_texts(["query", scene, "--text", scene]) == ["query", scene, "--text", scene]
    assert cli.with_all_texts(["teach", scene, "--text=a", "b"]) == ["teach", scene, "--text=a", "b"]


@pytest.mark.parametrize(
    "words",
    [
        ["teach", "a.scene", "--word", "door", "--photo", "a", "--at", "1,1", "--photo", "b", "--at", "2,2"],
        ["export", "a.scene", "--out=a.ply", "--out", "b.spz"],
        ["train", "photos", "--photo_scale", "1", "--photo-scale", "0.5"],
    ],
)
def test_a_value_that_would_count_for_nothing_is_told(words):
    with pytest.raises(SystemExit, match=r"--(photo|out|photo-scale) is given 2 times: give it once"):
        cli.main(words)


@pytest.mark.parametrize("word", ["castl.scene", "castl.GLB", "../runs/castle"])
def test_a_mistyped_scene_is_no_text_of_the_newest_run(word):
    for text in ("St. Mary", "doors and/or gates"):
        assert cli.with_all_texts(["query", "--text", word, text])[-2:] == ["--text", text]
    with pytest.raises(SystemExit, match=f"{word} does not exist: correct the name"):
        cli.main(["query", "--text", "windows", word])


@pytest.mark.parametrize("command", ["train", "reconstruct", "prepare", "needs"])
@pytest.mark.parametrize("spelled", [["photos"], ["--data", "photos"], ["--data=photos"]])
def test_a_folder_of_photos_is_taken_with_and_without_its_options_name(command, spelled):
    assert cli._parsed([command, *spelled]).data == Path("photos")


@pytest.mark.parametrize("command", ["query", "things", "export", "teach", "words", "info", "view"])
@pytest.mark.parametrize("spelled", [["a b"], ["--scene", "a b"], ["--load-config=a b"]])
def test_a_scene_is_taken_with_and_without_an_options_name(command, spelled):
    assert cli.with_place_as_taken([command, *spelled]) == [command, "a b"]
    if command != "teach":  # which wants a word too
        assert cli._parsed([command, *spelled]).scene == Path("a b")


def test_a_port_that_is_taken_is_not_replaced_silently():
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        pytest.raises(SystemExit, match="is taken by another program"),
    ):
        cli.main(["view", "none", "--port", str(server.getsockname()[1])])


def test_a_photo_with_a_very_long_name_still_has_files():
    names = file_names(["ä" * 120 + ".jpg", "ä" * 120 + "b.jpg", "a.jpg"])
    assert len(set(names)) == 3 and max(len(f"{n}.overlay.png".encode()) for n in names) <= 255


def test_a_reader_that_has_seen_enough_is_no_error():
    done = shell("preset | head -c 1; exit ${PIPESTATUS[0]}")
    assert b"Traceback" not in done.stderr and b"Exception ignored" not in done.stderr


def test_a_folder_that_is_gone_is_named(tmp_path, monkeypatch):
    (gone := tmp_path / "gone").mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with pytest.raises(SystemExit, match="the current folder was deleted"):
        cli.main(["info", str(tmp_path / "a.scene")])


def test_a_closed_output_is_no_error(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    cli.main(["preset", "official"])


def test_no_file_gets_the_number_of_a_stream_that_was_closed(tmp_path):
    """What libraries print there would be written into it."""
    cli_main = "from lang3dxl_ns.cli import main; main(['--version'])"
    code = f"{cli_main}; file = open('out', 'w'); file.write(str(file.fileno()))"
    words = [sys.executable, "-c", code]
    subprocess.run(["bash", "-c", '"$@" <&- >&- 2>&-', "bash", *words], cwd=tmp_path, timeout=120, check=True)
    assert int((tmp_path / "out").read_text()) > 2


def test_a_full_output_is_one_line():
    done = shell("preset > /dev/full")
    assert done.returncode == 1
    assert done.stderr.decode().strip() == "Error: the output can't be written: No space left on device"


@pytest.mark.parametrize(
    ("encoding", "shown"), [("ascii", b"fa\\xe7ade \\u2026\n"), ("latin-1", b"fa\xe7ade \\u2026\n")]
)
def test_consoles_without_a_character_show_it_escaped(monkeypatch, encoding, shown):
    narrow = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", narrow)
    accept_any_console()
    print("façade …", flush=True)
    assert narrow.buffer.getvalue() == shown


def test_a_command_runs_on_a_latin_1_console():
    """Helps and messages hold dashes and ellipses that Latin-1 lacks."""
    done = shell("query --help", PYTHONIOENCODING="latin-1", PYTHONUTF8="0")
    assert done.returncode == 0 and b"Traceback" not in done.stderr


def scene(folder, **figures):
    folder.mkdir(parents=True)
    (folder / "scene.json").write_text(json.dumps(figures))


def test_another_demo_finds_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene(tmp_path / "lang3dxl-demo" / "scene", seed=2, wild=True, photos=24, test_views=8)
    assert Demo(quick=True)._folder().name == "lang3dxl-demo"
    assert Demo()._folder().name == "lang3dxl-demo-2"
    scene(tmp_path / "lang3dxl-demo-2" / "scene", seed=2, wild=True, photos=48, test_views=24)
    assert Demo()._folder().name == "lang3dxl-demo-2"
    with pytest.raises(UserError, match=r"photos 24, not 48"):
        Demo(out=tmp_path / "lang3dxl-demo")._folder()


@pytest.mark.parametrize("text", ["", "3", "[" * 9999])
def test_a_damaged_description_of_a_demo_is_named(tmp_path, text):
    scene(tmp_path / "demo" / "scene")
    (tmp_path / "demo" / "scene" / "scene.json").write_text(text)
    with pytest.raises(UserError, match=r"scene\.json can't be read"):
        Demo(out=tmp_path / "demo")._folder()
