"""Finding a run from a folder above it."""

import os
import shutil

import pytest

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.runs import find_config, find_run
from lang3dxl_ns.open_scene import existing_scene_file, find_scene_file
from lang3dxl_ns.scene.record import SCENE_FILE


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Two runs of two scenes; the second is newer."""
    monkeypatch.chdir(tmp_path)
    made = []
    for i, name in enumerate(("outputs/a/lang3dxl/2024", "outputs/b/lang3dxl/2023")):
        (tmp_path / name).mkdir(parents=True)
        path = tmp_path / name / "config.yml"
        path.touch()
        path.with_name(SCENE_FILE).touch()
        os.utime(path, (1000 + i, 1000 + i))
        made.append(path)
    return made


def test_the_newest_under_outputs_is_found(runs):
    assert find_config().resolve() == runs[1]
    assert find_config("outputs").resolve() == runs[1]


def test_the_newest_is_the_one_that_began_last_also_in_a_copy_and_is_named(runs, tmp_path, capsys):
    """A copy's files are of the moment when they were copied, in any order."""
    for day, time in (("2026-03-01_101500", 1), ("2026-02-28_235959", 9e8), ("2025-12-31_000000", 2)):
        folder = runs[0].parent.with_name(day)
        shutil.copytree(runs[0].parent, folder)
        os.utime(folder / "config.yml", (time, time))
    assert find_config().parent.name == "2026-03-01_101500"
    assert "a/lang3dxl/2026-03-01_101500, the newest of 5 runs in outputs" in capsys.readouterr().out
    find_config(runs[1].parent)  # the only one there
    assert not capsys.readouterr().out


def test_a_folder_names_its_own_runs(runs, tmp_path):
    for place in (runs[0], runs[0].parent, tmp_path / "outputs" / "a", str(runs[0].parent)):
        assert find_config(place).resolve() == runs[0]
    (tmp_path / "outputs" / "config.yml").touch()
    assert find_config(tmp_path / "outputs") == tmp_path / "outputs" / "config.yml"


def test_newer_runs_of_other_methods_are_skipped(runs, tmp_path):
    other = tmp_path / "outputs" / "b" / "splatfacto" / "2025"
    other.mkdir(parents=True)
    (other / "config.yml").touch()
    assert find_config().resolve() == runs[1]
    assert find_config(other).resolve() == other / "config.yml"  # named, so that the error can say why
    with pytest.raises(UserError, match=r"no run of this method \(1 of others\)"):
        find_config(other.parent)


@pytest.mark.parametrize("place", ["nowhere", "nowhere/config.yml", "\0"])
def test_wrong_places_are_one_sentence(runs, place):
    with pytest.raises(UserError, match=r"is not a file or folder|is not a path"):
        find_config(place)


def test_folders_without_a_run_say_how_to_make_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"no outputs/ here.*lang3dxl train"):
        find_config()
    with pytest.raises(UserError, match=r"holds no run.*lang3dxl train"):
        find_config(tmp_path)


def test_a_run_is_found_by_its_scene_file_too_and_a_word_taught_later_makes_it_no_newer(runs, tmp_path):
    """`lang3dxl train` writes a scene and no config.yml; teaching writes into the scene."""
    folder = tmp_path / "outputs" / "c"
    folder.mkdir()
    record, scene, hidden = folder / SCENE_FILE, folder / "c.scene", runs[0].with_name("._a.scene")
    for path in (record, hidden):
        path.touch()
    assert find_run().resolve() == runs[1].parent  # neither is a scene yet
    scene.touch()
    (deleted := tmp_path / "outputs" / ".trash" / "d.scene").parent.mkdir()
    deleted.touch()
    for began, newest in ((5000, folder), (500, runs[1].parent)):
        os.utime(record, (began, began))
        os.utime(scene, (9000, 9000))
        for place in (None, "outputs"):
            assert find_run(place).resolve() == newest
            found = find_scene_file(place)
            assert found is None if newest == runs[1].parent else scene.samefile(found)
    os.utime(record, (5000, 5000))
    with pytest.raises(UserError, match="is no run of ns-train"):
        find_config()
    assert find_run("outputs/c") == folder.relative_to(tmp_path) and find_run(scene) == scene


def test_a_run_with_a_copy_of_its_scene_asks_which_is_meant(runs):
    """A word must not be taught to the backup."""
    scene, backup = runs[1].with_name("b.scene"), runs[1].with_name("backup.scene")
    scene.touch()
    assert existing_scene_file().samefile(scene)
    backup.touch()
    with pytest.raises(UserError, match=r"holds several scenes \(b.scene, backup.scene\): name one"):
        existing_scene_file()
    assert existing_scene_file(backup) == backup
