"""Laws of preparation: no repeated work, no partial files, isolated failures."""

from __future__ import annotations

import collections
import errno
import math
import os
import re
import shutil
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_models import make_tiny_clip, make_tiny_dinov2

from lang3dxl_ns.common import console as progress
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.stages import roughly
from lang3dxl_ns.preparation import kinds
from lang3dxl_ns.preparation import prepare as module
from lang3dxl_ns.preparation.dense_map import build_dense_map, map_grids, nested_grids
from lang3dxl_ns.preparation.encoders import DenseEncoder, ImageTextEncoder, load_image_text_encoder
from lang3dxl_ns.preparation.families import FILE, PatchHead
from lang3dxl_ns.preparation.prepare import TargetReader, prepare
from lang3dxl_ns.preparation.pyramid import build_clip_target
from lang3dxl_ns.preparation.regions import FelzenszwalbRegions, FolderRegions, stored_labels
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.working_photos import WorkingPhotos
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.photo import Photo

SCALES = [0.4, 0.8]  # of the photo's width
NAMES = ["north/a.png", "north/b.png", "south/a.png"]


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return {
        "clip": str(make_tiny_clip(folder / "clip", dim=16, image_size=16)),
        "other_clip": str(make_tiny_clip(folder / "other", dim=16, image_size=16, seed=1)),
        "wide_clip": str(make_tiny_clip(folder / "wide", dim=24, image_size=16)),
        "dense": str(make_tiny_dinov2(folder / "dense", dim=8, patch=4)),
    }


@pytest.fixture
def config(models):
    return PreparationConfig(clip=models["clip"], dense=models["dense"], dense_tokens=6, crop_batch=7)


@pytest.fixture
def photos(tmp_path):
    return [make_photo(tmp_path, name, seed) for seed, name in enumerate(NAMES)]


@pytest.fixture
def store(tmp_path):
    return FeatureStore(tmp_path / "store")


@pytest.fixture
def calls(monkeypatch):
    """How many photos each network and the reader have seen."""
    counts = collections.Counter()

    def count(owner, method, key):
        original = getattr(owner, method)

        def counting(*arguments):
            counts[key] += 1
            return original(*arguments)

        monkeypatch.setattr(owner, method, counting)

    count(kinds, "build_clip_target", "clip")
    count(DenseEncoder, "encode", "dense")
    count(Photo, "read_uint8", "read")
    count(FelzenszwalbRegions, "labels", "regions")
    count(kinds, "load_image_text_encoder", "clip loaded")
    count(kinds, "load_dense_encoder", "dense loaded")
    return counts


def make_photo(folder, name, seed, size=(100, 80)):
    path = folder / "images" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    return Photo(name, path, None, Lens(*size, fx=90.0, fy=96.0, cx=size[0] / 2, cy=size[1] / 2))


def run(photos, config, store, scales=SCALES, pixel_sizes=None, regions=None):
    """Prepare: the reader, and for how many photos an entry was made."""
    before = files(store)
    reader = prepare(photos, pixel_sizes, config, scales, store, "cpu", regions)
    made = {path.name for path, file in files(store).items() if before.get(path) != file}
    return SimpleNamespace(reader=reader, encoded=sum(store.path("", p.name).name in made for p in photos))


def files(store):
    """Each entry's inode, which changes when it is written anew, in the same second too."""
    return {path: path.stat().st_ino for path in store.root.glob("*/*")}


def entries(store):
    return {path.name: path.stat().st_mtime_ns for path in store.root.glob("*/*")}


def test_fine_crops_are_the_smallest_and_smaller_ones_on_a_finer_grid(photos, config, store, models):
    pyramid = run(photos, config, store).reader.clip("north/b.png")
    reader = prepare(photos, None, config, SCALES, store, "cpu", fine=["north/b.png"])
    clip = load_image_text_encoder(models["clip"], "cpu")
    crops = [28, 40]  # 0.7 of 40 pixels, and these
    expected = build_clip_target(photos[1].read(), crops, clip.encode_images, clip.crop_size, 64, steps=3)
    found = reader.clip("north/b.png")
    torch.testing.assert_close(found.features, expected.features.half(), atol=2e-3, rtol=2e-3)
    assert found.crop_fractions == [0.28, 0.4]
    assert found.features.shape[0] >= 2 * pyramid.features.shape[0]
    assert reader.clip("south/a.png").crop_fractions == [0.4, 0.8]


def test_the_reader_gives_what_the_encoders_made(photos, config, store, models):
    targets = run(photos, config, store)
    clip = load_image_text_encoder(models["clip"], "cpu")
    expected = build_clip_target(photos[1].read(), [40, 80], clip.encode_images, clip.crop_size, 64)
    found = targets.reader.clip("north/b.png")
    torch.testing.assert_close(found.features, expected.features.half(), atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(found.valid, expected.valid.half())
    assert found.crop_fractions == [0.4, 0.8]
    assert targets.reader.names == NAMES
    assert targets.encoded == 3
    assert (targets.reader.clip_dim, targets.reader.dense_dim) == (16, 8)
    assert targets.reader.dense("south/a.png").shape == (6, 6, 8)


def test_physical_scales_follow_each_photos_pixel_size(photos, config, store):
    reader = run(photos, config, store, [2.0, 4.0], dict(zip(NAMES, [0.05, 0.1, 0.04], strict=True))).reader
    assert [reader.clip(name).crop_fractions for name in NAMES] == [[0.4, 0.8], [0.32, 0.4], [0.5, 1.0]]


def test_a_second_run_makes_nothing_and_loads_no_model(photos, config, store, calls):
    run(photos, config, store)
    assert calls == {"clip": 3, "dense": 3, "read": 3, "clip loaded": 1, "dense loaded": 1}
    calls.clear()
    before = entries(store)
    targets = run(photos, config, store)
    assert calls == {}
    assert targets.encoded == 0
    assert entries(store) == before


def test_a_changed_photo_is_made_again_alone(photos, config, store, calls, tmp_path):
    run(photos, config, store)
    calls.clear()
    make_photo(tmp_path, NAMES[1], seed=9)
    assert run(photos, config, store).encoded == 1
    assert (calls["clip"], calls["dense"]) == (1, 1)


def test_a_new_camera_matters_only_where_it_undistorts(photos, config, store, calls):
    run(photos, config, store)
    calls.clear()
    refined = [replace(photo, lens=replace(photo.lens, fx=91.0)) for photo in photos]
    assert run(refined, config, store).encoded == 0
    refined[0] = replace(photos[0], lens=replace(photos[0].lens, distortion=(0.1, 0.0, 0.0, 0.0)))
    assert run(refined, config, store).encoded == 1


@pytest.mark.parametrize(
    ("change", "made"),
    [
        ({"dense_tokens": 5}, {"dense": 3, "read": 3, "dense loaded": 1}),
        ({"clip": "other_clip"}, {"clip": 3, "read": 3, "clip loaded": 1}),
        ({"dense": "none"}, {}),
        ({"crop_batch": 3}, {}),
    ],
)
def test_a_changed_setting_makes_only_what_depends_on_it(photos, config, store, calls, models, change, made):
    run(photos, config, store)
    calls.clear()
    run(photos, replace(config, **{key: models.get(value, value) for key, value in change.items()}), store)
    assert calls == made


def test_changed_scales_make_only_the_photos_whose_crops_change(photos, config, store, calls):
    sizes = dict(zip(NAMES, [0.05, 0.05, 0.2], strict=True))  # in the last photo both scales clip to 32 px
    run(photos, config, store, [2.0, 4.0], sizes)
    calls.clear()
    run(photos, config, store, [2.0, 3.0], sizes)
    assert calls == {"clip": 2, "read": 2, "clip loaded": 1}


def test_the_next_photos_are_read_while_one_is_encoded(photos, config, store, monkeypatch):
    together, read = threading.Barrier(2, timeout=60), WorkingPhotos.read

    def reading(self, photo, scale=1.0):
        together.wait()
        return read(self, photo, scale)

    monkeypatch.setattr(WorkingPhotos, "read", reading)
    assert prepare(photos[:2], None, config, SCALES, store, "cpu").names == NAMES[:2]


def test_a_damaged_entry_is_made_again_alone(photos, config, store, calls):
    reader = run(photos, config, store).reader
    expected = reader.clip(NAMES[2]).features.clone()
    calls.clear()
    path = store.path("clip", NAMES[2])
    path.write_bytes(path.read_bytes()[:-10])
    assert torch.equal(run(photos, config, store).reader.clip(NAMES[2]).features, expected)
    assert calls == {"clip": 1, "read": 1, "clip loaded": 1}


def test_an_interrupted_run_goes_on_where_it_stopped(photos, config, store, calls, monkeypatch):
    write = FeatureStore.write

    def interrupted(self, kind, name, *rest):
        if (kind, name) == ("dense", NAMES[1]):
            raise KeyboardInterrupt
        write(self, kind, name, *rest)

    monkeypatch.setattr(FeatureStore, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(photos, config, store)
    monkeypatch.setattr(FeatureStore, "write", write)
    calls.clear()
    assert run(photos, config, store).reader.names == NAMES
    assert (calls["clip"], calls["dense"], calls["read"]) == (1, 2, 2)


def test_an_unreadable_photo_is_left_out_and_named(photos, config, store, capsys):
    photos[0].path.write_bytes(b"not a photo")
    photos[2].path.unlink()
    targets = run(photos, config, store)
    assert targets.reader.names == [NAMES[1]]
    assert targets.encoded == 1
    printed = capsys.readouterr().out
    assert "left out 2 of 3" in printed
    assert NAMES[0] in printed
    assert NAMES[2] in printed


def test_no_readable_photo_at_all_is_a_users_error(photos, config, store):
    for photo in photos:
        photo.path.unlink()
    with pytest.raises(
        UserError, match=r"no photo can be prepared; the first of \d+: [^;]*north/a\.png[^;]*$"
    ):
        run(photos, config, store)
    with pytest.raises(UserError, match="the scene has none"):
        run([], config, store)


def test_the_announced_size_is_that_of_the_stored_numbers(photos, config, store, capsys, monkeypatch):
    needed = []
    monkeypatch.setattr(module, "gigabytes", lambda size: needed.append(size) or f"{size} bytes")
    run(photos, config, store, regions=FelzenszwalbRegions())
    kinds = ("clip", "dense", "regions")
    payload = [tensor for name in NAMES for kind in kinds for tensor in store.read(kind, name).values()]
    assert needed[0] == sum(tensor.nbytes for tensor in payload)
    assert f"preparing 3 photos (0 of 3 are ready): {needed[0]} bytes" in capsys.readouterr().out


def test_an_announced_duration_is_that_of_large_batches_and_names_remedies_that_help(
    photos, config, store, capsys, monkeypatch
):
    """Threads that wait for each other make every batch, small or large, as slow: half a second announced for
    each of thousands of crops is hours."""
    clock, encode = [0.0], ImageTextEncoder.encode_images

    def encode_images(self, crops):
        clock[0] += 0.5
        return encode(self, crops)

    monkeypatch.setattr(ImageTextEncoder, "encode_images", encode_images)
    monkeypatch.setattr(module.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(module, "_ANNOUNCED_CROPS", 0)
    monkeypatch.setattr(module, "_LONG_S", 0.0)
    run(photos, replace(config, dense="none", crop_batch=64), store)
    told = capsys.readouterr().out.replace("\n", " ")
    (crops,) = re.findall(r"([\d,]+) crops with", told)
    assert int(crops) > 64
    assert f"{roughly(int(crops) * 0.5 / 64)}" in told
    assert "clip builtin if its words suffice" in told
    assert "quality fast" not in told


def test_as_many_windows_are_announced_as_are_encoded(photos, config, store, capsys, monkeypatch):
    encoded, encode = [], ImageTextEncoder.encode_patches
    counting = lambda self, windows: encoded.append(len(windows)) or encode(self, windows)  # noqa: E731
    monkeypatch.setattr(ImageTextEncoder, "encode_patches", counting)
    monkeypatch.setattr(module, "_ANNOUNCED_CROPS", 0)
    run(photos, replace(config, clip_features="dense"), store)
    (announced,) = re.findall(r"([\d,]+) crops with", capsys.readouterr().out)
    assert int(announced) == sum(encoded) > 0


def test_a_disk_that_is_too_small_is_found_before_the_work(photos, config, store, calls, monkeypatch):
    usage = shutil.disk_usage(".")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(UserError, match=r"targets of 3 photos need .* and 1\.00 kB are free"):
        run(photos, config, store)
    assert (calls["clip"], calls["dense"]) == (0, 0)
    assert entries(store) == {}


def test_a_disk_that_fills_up_keeps_what_was_written_and_nothing_half_written(
    photos, config, store, monkeypatch
):
    fsync, written = os.fsync, []

    def full_after_two(handle):
        written.append(handle)
        if len(written) > 3:  # the first are the photos' hashes
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", full_after_two)
    with pytest.raises(UserError, match="no space left"):
        run(photos, config, store)
    assert set(entries(store)) == {store.path(kind, NAMES[0]).name for kind in ("clip", "dense")}
    monkeypatch.undo()
    assert run(photos, config, store).encoded == 2


def test_dense_clip_features_take_the_place_of_crops(photos, config, store, calls, models):
    crops = run(photos, config, store).reader.clip("north/b.png")
    dense = replace(config, clip_features="dense")
    calls.clear()
    reader = run(photos, dense, store).reader
    assert calls == {"clip loaded": 1, "read": 3}  # no crop, and DINO's entries stay
    found = reader.clip("north/b.png")
    clip = load_image_text_encoder(models["clip"], "cpu")
    grids = map_grids(80, 100, tokens=4, least=6)
    expected = build_dense_map(photos[1].read(), grids, clip.encode_patches, 4, clip.patch_size, 1)
    torch.testing.assert_close(found.features, expected.half(), atol=2e-3, rtol=2e-3)
    assert found.features.shape[:2] == grids[-1] != crops.features.shape[:2]
    assert (found.valid == 1).all() and found.crop_fractions == sorted(found.crop_fractions)
    calls.clear()
    assert run(photos, dense, store).encoded == 0 and not calls
    assert run(photos, replace(dense, dense_tokens=12), store).encoded == 3


def test_training_photos_are_maps_by_the_clips_patch_head_and_others_crops(photos, config, store, models):
    from safetensors.torch import save_file
    from transformers import CLIPModel

    channels, width = CLIPModel.from_pretrained(models["clip"]).visual_projection.weight.shape
    folder = store.root.parent / "with_head"
    shutil.copytree(models["clip"], folder)
    save_file(PatchHead(width, channels, 3, 8).state_dict(), folder / FILE)
    fine = prepare(photos, None, config, SCALES, store, "cpu", fine=[NAMES[1]])
    side, others = round(100 * fine.clip(NAMES[1]).crop_fractions[0]), fine.clip(NAMES[0])
    own = replace(config, clip=str(folder))
    reader = prepare(photos, None, own, SCALES, store, "cpu", fine=[NAMES[1]])
    clip, found = load_image_text_encoder(folder, "cpu"), reader.clip(NAMES[1])
    grids = nested_grids(80, 100, 4, side, 3)
    tokens = build_dense_map(
        photos[1].read(), grids, clip.encode_patches, 4, clip.patch_size, 1, lambda sizes: sizes
    )
    torch.testing.assert_close(found.features, clip.join_sizes(tokens).half(), atol=2e-3, rtol=2e-3)
    assert found.crop_fractions == [math.ceil(100 / grids[-1][1]) / 100]
    assert torch.equal(reader.clip(NAMES[0]).features, others.features)  # as the 2-D teacher


def test_without_dense_features_no_dense_entry_is_made_or_read(photos, config, store):
    reader = run(photos, replace(config, dense="none"), store).reader
    assert reader.dense(NAMES[0]) is None
    assert reader.dense_dim == 0
    assert not (store.root / "dense").exists()
    assert reader.feature_statistics().dense is None


def test_photos_with_fine_crops_alone_have_dense_features_where_there_are_such(photos, config, store):
    reader = prepare(photos, None, config, SCALES, store, "cpu", fine=[NAMES[1]])
    assert [name for name in NAMES if reader.dense(name) is not None] == [NAMES[1]]
    assert [tuple(dense.shape) for dense in reader.dense_features(NAMES)] == [(6, 6, 8)]
    assert reader.dense_dim == 8


def test_regions_are_read_as_their_source_made_them(photos, config, store):
    source = FelzenszwalbRegions()
    reader = run(photos, config, store, regions=source).reader
    for photo in photos:
        expected = stored_labels(source.labels(photo, photo.read()))
        assert torch.equal(reader.regions(photo.name), expected)
        assert expected.max() > 0


def test_without_regions_none_are_made_or_read(photos, config, store, calls, monkeypatch):
    run(photos, config, store, regions=FelzenszwalbRegions())
    read = []
    original = FeatureStore.read
    monkeypatch.setattr(FeatureStore, "read", lambda *args: read.append(args[1]) or original(*args))
    reader = run(photos, config, store).reader  # an earlier run's entries exist and are left alone
    assert reader.regions(NAMES[0]) is None
    assert "regions" not in read


def test_changed_regions_make_only_regions(photos, config, store, calls, monkeypatch):
    run(photos, config, store)
    calls.clear()
    run(photos, config, store, regions=FelzenszwalbRegions())
    assert calls == {"regions": 3, "read": 3}
    calls.clear()
    assert run(photos, config, store, regions=FelzenszwalbRegions()).encoded == 0
    settings = FelzenszwalbRegions.settings
    monkeypatch.setattr(
        FelzenszwalbRegions, "settings", lambda self, photo: {**settings(self, photo), "scale": 3}
    )
    run(photos, config, store, regions=FelzenszwalbRegions())
    assert calls == {"regions": 3, "read": 3}


def test_interrupted_regions_go_on_where_they_stopped(photos, config, store, calls, monkeypatch):
    write = FeatureStore.write

    def interrupted(self, kind, name, *rest):
        if (kind, name) == ("regions", NAMES[1]):
            raise KeyboardInterrupt
        write(self, kind, name, *rest)

    monkeypatch.setattr(FeatureStore, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(photos, config, store, regions=FelzenszwalbRegions())
    monkeypatch.setattr(FeatureStore, "write", write)
    calls.clear()
    run(photos, config, store, regions=FelzenszwalbRegions())
    assert (calls["clip"], calls["dense"], calls["regions"]) == (1, 1, 2)


def test_a_photo_without_a_label_map_has_no_regions_and_is_named(photos, config, store, tmp_path, capsys):
    folder = tmp_path / "regions" / "north"
    folder.mkdir(parents=True)
    for name in ("a", "b"):
        np.save(folder / f"{name}.npy", np.arange(6).reshape(2, 3))
    reader = run(photos, config, store, regions=FolderRegions(tmp_path / "regions")).reader
    assert torch.equal(reader.regions(NAMES[0]), torch.arange(6).reshape(2, 3).short())
    assert reader.regions(NAMES[2]) is None
    assert "1 of 3 photos have no regions: south/a.png" in capsys.readouterr().out


def test_a_network_that_gives_no_numbers_is_a_users_error_that_names_the_photo(
    photos, config, store, monkeypatch
):
    monkeypatch.setattr(
        ImageTextEncoder, "encode_images", lambda self, crops: torch.full((len(crops), 16), torch.nan)
    )
    with pytest.raises(UserError, match=r"north/a\.png.*NaN"):
        run(photos, config, store)


def test_statistics_are_numpys_in_float64(store):
    generator = torch.manual_seed(0)
    maps = {}
    for index in range(5):
        features = (
            3 + index + torch.randn(6 + index, 7, 4, generator=generator) * torch.tensor([0.1, 1, 2, 0])
        )
        settings = {"size": [100, 80], "crop_sides": [40]}
        store.write("clip", str(index), {"features": features, "valid": torch.ones(6 + index, 7)}, settings)
        store.write("dense", str(index), {"features": features * 2 - 100}, {})
        maps[index] = store.read("clip", str(index))["features"].numpy().astype(np.float64).reshape(-1, 4)
    names = [str(index) for index in maps]
    made_with = {"clip": settings, "dense": {}}
    reader = TargetReader(store, dict.fromkeys(names, made_with))
    pixels = np.concatenate(list(maps.values()))
    found = reader.feature_statistics()
    np.testing.assert_allclose(found.clip.mean, pixels.mean(0), rtol=1e-6)
    np.testing.assert_allclose(found.clip.std, pixels.std(0), rtol=1e-6)
    dense = np.concatenate(
        [store.read("dense", str(index))["features"].numpy().astype(np.float64) for index in [0, 3]]
    )
    np.testing.assert_allclose(
        reader.feature_statistics(["0", "3"]).dense.mean, dense.mean((0, 1)), rtol=1e-6
    )
    sampled = np.concatenate([maps[0], maps[3]])  # at most two of five: every third
    np.testing.assert_allclose(reader.feature_statistics(sample=2).clip.mean, sampled.mean(0), rtol=1e-6)


def test_the_deviation_of_a_constant_channel_is_floored(store):
    features = torch.stack(
        [torch.full((8, 8), 5.0), torch.randn(8, 8, generator=torch.manual_seed(0))], dim=-1
    )
    settings = {"size": [9, 9], "crop_sides": [3]}
    store.write("clip", "a", {"features": features, "valid": torch.ones(8, 8)}, settings)
    std = TargetReader(store, {"a": {"clip": settings}}).feature_statistics().clip.std
    assert std[0] == pytest.approx(0.01 * float(std[1]) / 2, rel=1e-3)


@pytest.mark.parametrize("kind", ["clip", "dense"])
def test_targets_that_another_command_makes_otherwise_meanwhile_are_refused(store, kind):
    def write(content, settings):
        features = torch.full((4, 4, 2), content)
        store.write("clip", "a", {"features": features, "valid": torch.ones(4, 4)}, settings)
        store.write("dense", "a", {"features": features}, settings)

    settings = {"size": [9, 9], "crop_sides": [3], "encoder": "first"}
    write(1.0, settings)
    reader = TargetReader(store, {"a": {"clip": settings, "dense": settings}})
    read = {"clip": lambda: reader.clip("a").features, "dense": lambda: reader.dense("a")}[kind]
    assert (read() == 1).all()
    write(2.0, {**settings, "encoder": "second"})
    with pytest.raises(UserError, match=r"overwritten by another command.* a --cache-dir of its own"):
        read()
    write(1.0, settings)
    assert (read() == 1).all()
    with pytest.raises(UserError, match="targets of b are not prepared"):
        {"clip": reader.clip, "dense": reader.dense}[kind]("b")


def test_a_long_run_shows_a_bar(photos, config, store, monkeypatch, capsys):
    run(photos[:1], config, store)
    assert "encoding photos" not in capsys.readouterr().out
    monkeypatch.setattr(progress, "QUIET_S", 0.0)
    stamp = Photo.stamp
    monkeypatch.setattr(Photo, "stamp", lambda *given: time.sleep(0.05) or stamp(*given))
    run(photos, config, store)
    printed = capsys.readouterr().out
    assert "checking photos" in printed
    assert "encoding photos" in printed
    assert "2/2" in printed


def test_the_configuration_is_a_command_line(models):
    import tyro

    config = tyro.cli(PreparationConfig, args=["--clip", models["clip"], "--scale-range", "0.2", "0.9"])
    assert (config.clip, config.scale_range, config.dense_tokens) == (models["clip"], (0.2, 0.9), 64)
