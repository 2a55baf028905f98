"""User mistakes in data and options: one sentence that names the mistake and the remedy."""

import shutil
from pathlib import Path

import pytest
from PIL import Image
from processes import Process
from runs import train_run

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.pipeline import print_user_errors_plainly


@pytest.fixture
def folder(scene, tmp_path):
    """A copy of the scene to damage."""
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy, ignore=shutil.ignore_patterns("lang3dxl_cache"))
    return copy


@pytest.fixture
def start(tiny_clip, tiny_dense, tmp_path):
    """Set up a run and do its first steps."""

    def run(data, semantics=True, iterations=2, **changes):
        folder = tmp_path / "out"
        return train_run(data, tiny_clip, tiny_dense, folder, iterations, semantics, **changes)

    return run


def test_no_such_folder(start, tmp_path):
    with pytest.raises(UserError, match="nowhere is not a folder"):
        start(tmp_path / "nowhere")


def test_a_misspelled_colmap_model_is_not_replaced_by_another(start, folder):
    with pytest.raises(UserError, match="no COLMAP model"):
        start(folder, pipeline__datamanager__dataparser__colmap_path=Path("sparse/geo"))


def test_neither_colmap_model_nor_photos(start, folder):
    shutil.rmtree(folder / "sparse")
    shutil.rmtree(folder / "images")
    with pytest.raises(UserError, match="is empty: give the folder with your photos"):
        start(folder)
    (folder / "notes.txt").write_text("no photo")
    with pytest.raises(UserError, match=r"holds no photos and no COLMAP model.*lang3dxl reconstruct"):
        start(folder)


def test_empty_colmap_model(start, folder):
    import pycolmap

    pycolmap.Reconstruction().write_binary(folder / "sparse" / "0")
    with pytest.raises(UserError, match="no photo with a pose"):
        start(folder)


def test_all_photos_missing(start, folder):
    shutil.rmtree(folder / "images")
    (folder / "images").mkdir()
    with pytest.raises(UserError, match=r"none of the 12 photos of .* can be used"):
        start(folder)


def test_photos_that_are_missing_damaged_or_of_another_size_are_left_out_and_named(start, folder, capsys):
    _, missing, damaged, other, *_ = sorted((folder / "images").iterdir())
    missing.unlink()
    damaged.write_bytes(b"not a picture")
    Image.new("RGB", (50, 300)).save(other)
    used = {p.name for p in start(folder, False).pipeline.datamanager.train_dataset.photos}
    printed = capsys.readouterr().out
    for photo in (missing, damaged, other):
        assert photo.name not in used and photo.name in printed


@pytest.mark.parametrize("semantics", [True, False])
def test_truncated_photo_does_not_end_the_run(start, folder, capsys, semantics):
    photo = sorted((folder / "images").iterdir())[1]
    photo.write_bytes(photo.read_bytes()[:-400])
    trainer = start(folder, semantics, iterations=12)
    assert photo.name in capsys.readouterr().out
    dataset = trainer.pipeline.datamanager.train_dataset
    index = [p.name for p in dataset.photos].index(photo.name)
    assert trainer.pipeline.datamanager.data._left_out == {index}
    camera = dataset.cameras[index]  # ns-render draws its view
    assert dataset.get_data(index)["image"].shape == (int(camera.height), int(camera.width), 3)
    assert f"{photo.name} is shown black" in " ".join(capsys.readouterr().out.split())


def test_truncated_held_out_photo_does_not_end_the_evaluation(start, folder, capsys):
    photo = sorted((folder / "images").iterdir())[0]
    photo.write_bytes(photo.read_bytes()[:-400])
    trainer = start(folder)
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    assert f"{photo.name} is left out" in " ".join(capsys.readouterr().out.split())
    assert metrics["psnr"] > 0


def test_no_usable_held_out_photo(start, folder):
    for photo in sorted((folder / "images").iterdir())[::8]:
        photo.write_bytes(photo.read_bytes()[:-400])
    trainer = start(folder, semantics=False)
    with pytest.raises(UserError, match="none of the photos can be used"):
        trainer.pipeline.get_average_eval_image_metrics()


def test_zero_photos_in_a_split(start, folder):
    for photo in sorted((folder / "images").iterdir())[1:]:
        photo.unlink()
    with pytest.raises(UserError, match="one usable photo"):
        start(folder)


def fail_plainly():
    print_user_errors_plainly()
    raise UserError("photo 7 is upside down: turn it")


def test_commands_print_a_user_error_without_traceback():
    done = Process(fail_plainly).wait()
    assert done.returncode == 1
    assert "photo 7 is upside down: turn it" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr
