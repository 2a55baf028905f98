"""Bad input and failing hardware: a logged skip or an error that names the file, and no data loss."""

import pickle
import zipfile
from copy import deepcopy
from pathlib import Path

import pytest
import torch
import yaml
from PIL import Image
from runs import make_trainer
from scenes import write_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.memory import with_less_memory
from lang3dxl_ns.methods import lang3dxl
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.plugin.run_checkpoint import check_checkpoint
from lang3dxl_ns.plugin.trainer_config import read_config
from lang3dxl_ns.preparation.foreground import with_foreground
from lang3dxl_ns.preparation.pyramid import build_clip_target
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.query.relevancy import Queries, cosines_of_codes


@pytest.fixture
def folder(tmp_path):
    """A scene to damage."""
    return write_scene(tmp_path / "scene", photos=4, points=40)


def parse(folder, **options):
    """What the dataparser finds: its photos by name."""
    parser = PhotoCollectionDataParserConfig(data=folder, **options).setup()
    parser.get_dataparser_outputs(split="train")
    return {photo.name: photo for photo in parser.capture.photos}


def rename(folder, *names):
    """Give the photos other names, in the model and (where they stay inside) on disk."""
    import pycolmap

    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for image, name in zip(sorted(model.images.values(), key=lambda image: image.name), names, strict=False):
        old, image.name = folder / "images" / image.name, name
        target = folder / "images" / name
        if ".." not in name and not name.startswith("/"):
            target.parent.mkdir(parents=True, exist_ok=True)
            old.rename(target)
    model.write_binary(folder / "sparse" / "0")


# ── contents of the folder ──────────────────────────────────────────────────────────────────────────────


def test_photos_that_the_model_does_not_know_are_named(folder, capsys):
    Image.new("RGB", (8, 8)).save(folder / "images" / "stranger[1].JPG")
    assert len(parse(folder)) == 4
    assert "1 photos of" in (printed := capsys.readouterr().out)
    assert "stranger[1].JPG" in printed


def test_names_with_dots_spaces_unicode_folders_and_one_stem_stay_apart(folder, tmp_path):
    names = ["north side/a.b.jpg", "north side/a.b.png", "süd/ä 日本[/b].jpg", "a.b.jpg"]
    rename(folder, *names)
    photos = parse(folder)
    assert set(photos) == set(names)
    paths = {FeatureStore(tmp_path).path("clip", name) for name in names}
    assert len(paths) == 4


def test_a_mask_that_fits_two_photos_of_one_stem_is_named_and_the_long_form_tells_them_apart(folder, capsys):
    rename(folder, "a.jpg", "a.png")
    (folder / "masks").mkdir()
    Image.new("L", (9, 7), 255).save(folder / "masks" / "a.png")  # of another size, too

    def masks():
        photos = [photo for name, photo in parse(folder).items() if name[0] == "a"]
        capsys.readouterr()
        with_foreground(photos, PreparationConfig(), folder, folder / "cache", "cpu")
        return {photo.name: photo.mask_path.name for photo in photos}

    assert masks() == {"a.jpg": "a.png", "a.png": "a.png"}
    said = capsys.readouterr().out
    assert "the mask of 2 photos, a.jpg, a.png" in said
    assert "a.jpg.png" in said
    Image.new("L", (9, 7), 255).save(folder / "masks" / "a.jpg.png")
    assert masks() == {"a.jpg": "a.jpg.png", "a.png": "a.png"}
    assert not capsys.readouterr().out


# ── names and links that lead out of a folder ───────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", ["../secret.jpg", "/etc/passwd", "a/../../secret.jpg"])
def test_a_model_cannot_name_files_outside_the_photos_folder(folder, capsys, name):
    Image.new("RGB", (96, 72)).save(folder / "secret.jpg")
    rename(folder, name)
    assert len(parse(folder)) == 3
    assert "leads out of" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("what", ["images/photo_001.jpg", "masks/photo_001.png"])
def test_a_link_out_of_a_folder_is_followed_only_when_asked(folder, tmp_path, what, capsys):
    (folder / "masks").mkdir()
    Image.new("RGB", (96, 72)).save(tmp_path / "elsewhere.png")
    (folder / what).unlink(missing_ok=True)
    (folder / what).symlink_to(tmp_path / "elsewhere.png")
    assert "photo_001.jpg" not in parse(folder)
    assert "--follow-links" in " ".join(capsys.readouterr().out.split())
    assert "photo_001.jpg" in parse(folder, follow_links=True)


def test_the_photos_folder_itself_may_be_a_link(folder, tmp_path):
    (folder / "images").rename(tmp_path / "elsewhere")
    (folder / "images").symlink_to(tmp_path / "elsewhere")
    assert len(parse(folder)) == 4


# ── runs ────────────────────────────────────────────────────────────────────────────────────────────────


def damaged_checkpoint(folder, how):
    path = folder / "step-000000007.ckpt"
    torch.save({"step": 7, "pipeline": {"x": torch.arange(4000.0)}}, path)
    content = bytearray(path.read_bytes())
    if how == "cut":
        content = content[:-500]
    elif how == "flipped":
        content[len(content) // 2] ^= 1
    elif how == "empty":
        content = bytearray()
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("how", ["cut", "flipped", "empty"])
def test_a_damaged_checkpoint_is_named_by_every_command_that_loads_it(tmp_path, how):
    path = damaged_checkpoint(tmp_path, how)
    with pytest.raises(UserError, match=r"step-000000007\.ckpt is damaged"):
        check_checkpoint(path)
    config = lang3dxl.config
    config = type(config)(output_dir=tmp_path.parent, method_name="m", experiment_name="e", timestamp="t")
    config.relative_model_dir = tmp_path  # where nerfstudio's commands look
    with pytest.raises(UserError, match="is damaged"):
        config.get_checkpoint_dir()


def test_a_whole_checkpoint_passes(tmp_path):
    check_checkpoint(damaged_checkpoint(tmp_path, "not"))
    check_checkpoint(tmp_path / "none")


class Payload:
    """Unpickled by a careless reader, it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_a_checkpoint_that_runs_code_is_refused_and_runs_nothing(folder, tiny_clip, tiny_dense, tmp_path):
    trap, checkpoint = tmp_path / "trap", tmp_path / "step-000000001.ckpt"
    torch.save({"step": 1, "pipeline": Payload(trap)}, checkpoint)
    options = {"load_checkpoint": checkpoint}
    trainer = make_trainer(folder, tiny_clip, tiny_dense, tmp_path / "out", 4, semantics=False, **options)
    with pytest.raises(UserError, match="not a checkpoint of lang3dxl"):
        trainer.setup()
    assert not trap.exists()
    with zipfile.ZipFile(checkpoint) as archive:  # the trap would have worked
        pickle.loads(archive.read("step-000000001/data.pkl"))
    assert trap.exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda lines: [x for x in lines if "cache_gb:" not in x], r"lacks .*\.datamanager\.cache_gb"),
        (lambda lines: [x for x in lines if "max_skipped" not in x], "lacks the setting max_skipped_steps"),
        (lambda lines: [lines[0], "option_of_old: 3", *lines[1:]], "has the unknown setting option_of_old"),
    ],
)
def test_a_config_of_another_version_names_what_differs(tmp_path, change, says):
    lines = yaml.dump(lang3dxl.config).splitlines()
    (tmp_path / "config.yml").write_text("\n".join(change(lines)))
    with pytest.raises(UserError, match=says):
        read_config(tmp_path / "config.yml")


@pytest.mark.parametrize("machine", [{"num_devices": 2}, {"num_machines": 2}])
def test_several_devices_are_refused_before_anything_starts(machine):
    config = deepcopy(lang3dxl.config)
    vars(config.machine).update(machine)
    with pytest.raises(UserError, match="training runs on one device"):
        config.set_timestamp()


def test_servers_listen_on_this_machine_alone():
    assert lang3dxl.config.viewer.websocket_host == "127.0.0.1"


# ── memory ──────────────────────────────────────────────────────────────────────────────────────────────


def short_of_memory(limit, work):
    """`work`, failing like a GPU out of memory for more than `limit` rows."""

    def run(rows):
        if len(rows) > limit:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return work(rows)

    return run


def test_decoding_takes_smaller_chunks_when_memory_runs_out():
    codes, weights = torch.randn(1000, 3), torch.randn(3, 8)
    queries = Queries.of([torch.randn(1, 8)], torch.randn(4, 8))
    expected = cosines_of_codes(lambda part: part @ weights, codes, queries)
    found = cosines_of_codes(short_of_memory(70, lambda part: part @ weights), codes, queries)
    torch.testing.assert_close(found, expected)


def test_encoding_takes_smaller_batches_when_memory_runs_out():
    photo = torch.rand(64, 80, 3)

    def encode(crops):
        return crops.flatten(1)[:, :6]

    expected = build_clip_target(photo, [16, 32], encode, 8, 64).features
    found = build_clip_target(photo, [16, 32], short_of_memory(5, encode), 8, 64).features
    torch.testing.assert_close(found, expected)


def test_what_does_not_fit_even_one_by_one_is_an_error_and_others_are_not_hidden():
    with pytest.raises(torch.cuda.OutOfMemoryError):
        with_less_memory(lambda rows: short_of_memory(0, len)(range(rows)), 8)
    with pytest.raises(RuntimeError, match="size"):
        with_less_memory(lambda rows: torch.zeros(2) @ torch.zeros(3), 8)
