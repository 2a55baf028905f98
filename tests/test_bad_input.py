"""A user's mistake ends in one sentence that names it and the remedy, and loses nothing."""

import shutil

import pytest
from conftest import make_trainer
from PIL import Image

from lang3dxl_ns.errors import UserError


@pytest.fixture
def folder(scene, tmp_path):
    """A copy of the scene to be spoilt."""
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy, ignore=shutil.ignore_patterns("lang3dxl_cache"))
    return copy


@pytest.fixture
def start(tiny_clip, tiny_dense, tmp_path):
    """Sets a run up and does its first steps."""

    def run(data, semantics=True, iterations=2):
        trainer = make_trainer(data, tiny_clip, tiny_dense, tmp_path / "out", iterations, semantics)
        trainer.setup()
        trainer.train()
        return trainer

    return run


def test_no_such_folder(start, tmp_path):
    with pytest.raises(UserError, match="nowhere is not a folder"):
        start(tmp_path / "nowhere")


def test_no_colmap_model(start, folder):
    shutil.rmtree(folder / "sparse")
    with pytest.raises(UserError, match="no COLMAP model"):
        start(folder)


def test_empty_colmap_model(start, folder):
    import pycolmap

    pycolmap.Reconstruction().write_binary(folder / "sparse" / "0")
    with pytest.raises(UserError, match="no photo with a pose"):
        start(folder)


def test_photo_missing_on_disk(start, folder, capsys):
    photo = sorted((folder / "images").iterdir())[1]
    photo.unlink()
    assert left_out(start(folder), photo, capsys)


def test_all_photos_missing(start, folder):
    shutil.rmtree(folder / "images")
    (folder / "images").mkdir()
    with pytest.raises(UserError, match="none of the model's 12 photos can be used"):
        start(folder)


def left_out(trainer, photo, capsys) -> bool:
    """Whether the photo takes no part, and the log says so by its name."""
    used = {p.name for p in trainer.pipeline.datamanager.train_dataset.photos}
    return photo.name not in used and photo.name in capsys.readouterr().out


def test_size_that_disagrees_with_the_camera(start, folder, capsys):
    photo = sorted((folder / "images").iterdir())[1]
    Image.new("RGB", (50, 300)).save(photo)
    assert left_out(start(folder), photo, capsys)


def test_unreadable_photo(start, folder, capsys):
    photo = sorted((folder / "images").iterdir())[1]
    photo.write_bytes(b"not a picture")
    assert left_out(start(folder), photo, capsys)


@pytest.mark.parametrize("semantics", [True, False])
def test_truncated_photo_does_not_end_the_run(start, folder, capsys, semantics):
    photo = sorted((folder / "images").iterdir())[1]
    photo.write_bytes(photo.read_bytes()[:-400])
    trainer = start(folder, semantics, iterations=24)
    assert photo.name in capsys.readouterr().out
    index = [p.name for p in trainer.pipeline.datamanager.train_dataset.photos].index(photo.name)
    assert trainer.pipeline.datamanager._left_out == {index}


def test_truncated_held_out_photo_does_not_end_the_evaluation(start, folder, capsys):
    photo = sorted((folder / "images").iterdir())[0]
    photo.write_bytes(photo.read_bytes()[:-400])
    trainer = start(folder)
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    assert f"{photo.name} is left out of evaluation" in " ".join(capsys.readouterr().out.split())
    assert metrics["psnr"] > 0


def test_no_usable_held_out_photo(start, folder):
    for photo in sorted((folder / "images").iterdir())[::8]:
        photo.write_bytes(photo.read_bytes()[:-400])
    trainer = start(folder, semantics=False)
    with pytest.raises(UserError, match="none of the held-out photos"):
        trainer.pipeline.get_average_eval_image_metrics()


def test_zero_photos_in_a_split(start, folder):
    for photo in sorted((folder / "images").iterdir())[1:]:
        photo.unlink()
    with pytest.raises(UserError, match="one photo that can be used"):
        start(folder)


def test_commands_print_a_user_error_without_traceback(tmp_path):
    import subprocess
    import sys

    code = (
        "from lang3dxl_ns.pipeline import UserError, print_user_errors_plainly\n"
        "print_user_errors_plainly()\n"
        "raise UserError('photo 7 is upside down: turn it')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert "photo 7 is upside down: turn it" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr
