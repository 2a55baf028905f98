"""Laws of the feature store: atomic entries, one file per name, lazy reading."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.photo import Photo

SETTINGS = {"encoder": "abc", "crop_sides": [32, 64]}


@pytest.fixture
def store(tmp_path):
    return FeatureStore(tmp_path / "store")


def entry(seed=0):
    generator = torch.manual_seed(seed)
    return {
        "features": torch.randn(4, 5, 8, generator=generator),
        "valid": torch.rand(4, 5, generator=generator),
    }


def files(store):
    return sorted(path.name for path in store.root.rglob("*") if path.is_file())


def test_what_is_written_is_read_in_half_precision(store):
    written = entry()
    store.write("clip", "a.jpg", written, SETTINGS)
    found = store.read("clip", "a.jpg")
    assert found.keys() == written.keys()
    for key, tensor in found.items():
        assert torch.equal(tensor, written[key].half())
    assert store.is_current("clip", "a.jpg", SETTINGS)
    assert store.sizes() == {"clip": (1, store.path("clip", "a.jpg").stat().st_size)}


def test_whole_numbers_and_views_survive(store):
    labels = torch.arange(12, dtype=torch.int32).reshape(3, 4).T
    store.write("regions", "a.jpg", {"labels": labels}, {})
    assert torch.equal(store.read("regions", "a.jpg")["labels"], labels)


def test_numbers_beyond_half_precision_stay_float32_and_non_numbers_are_refused(store):
    store.write("clip", "big.jpg", {"features": torch.tensor([1e5, 1.0])}, {})
    assert torch.equal(store.read("clip", "big.jpg")["features"], torch.tensor([1e5, 1.0]))
    with pytest.raises(UserError, match=r"bad\.jpg.*NaN"):
        store.write("clip", "bad.jpg", {"features": torch.tensor([float("nan")])}, {})
    assert not store.path("clip", "bad.jpg").exists()


def test_odd_names_never_share_a_file(store):
    names = ["a/b.jpg", "a_b.jpg", "a b.jpg", "A/b.jpg", "x.jpg", "x.png", "x", "../x.jpg", "/x.jpg"]
    names += ["x:y|z?.jpg"]
    names += ["é.jpg", "e\u0301.jpg", "n" * 300, "n" * 301, "\udcff.jpg", "a\\b.jpg", ".hidden", ""]
    for index, name in enumerate(names):
        store.write("clip", name, {"index": torch.tensor(index)}, {"name": index})
    assert [int(store.read("clip", name)["index"]) for name in names] == list(range(len(names)))
    lower = {file.lower() for file in files(store)}  # also on case-insensitive file systems
    assert len(lower) == len(names)
    assert all(path.parent == store.root / "clip" for path in store.root.rglob("*.safetensors"))


def test_only_the_settings_that_made_an_entry_are_current(store):
    assert not store.is_current("clip", "a.jpg", SETTINGS)
    store.write("clip", "a.jpg", entry(), SETTINGS)
    assert store.is_current("clip", "a.jpg", dict(reversed(SETTINGS.items())))
    assert not store.is_current("clip", "a.jpg", {**SETTINGS, "encoder": "other"})
    assert not store.is_current("clip", "a.jpg", {"encoder": "abc"})
    assert not store.is_current("dense", "a.jpg", SETTINGS)


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_entry_and_nothing_else(store, monkeypatch, step):
    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(KeyboardInterrupt):
        store.write("clip", "a.jpg", entry(), SETTINGS)
    assert files(store) == []
    monkeypatch.undo()
    store.write("clip", "a.jpg", entry(), SETTINGS)
    before = files(store)
    monkeypatch.setattr(os, step, fail)
    with pytest.raises(KeyboardInterrupt):
        store.write("clip", "a.jpg", entry(1), {"encoder": "new"})
    assert files(store) == before
    assert store.is_current("clip", "a.jpg", SETTINGS)
    assert torch.equal(store.read("clip", "a.jpg")["features"], entry()["features"].half())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_process_killed_while_writing_leaves_no_entry_and_its_leftover_is_removed(store):
    child = os.fork()
    if child == 0:
        os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)
        store.write("clip", "a.jpg", entry(), {})
        os._exit(0)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    assert not store.is_current("clip", "a.jpg", {})
    (leftover,) = store.root.rglob("*.tmp")
    store.remove_leftovers()
    assert leftover.exists()  # recent: another process may be writing it
    os.utime(leftover, (time.time() - 7200,) * 2)
    store.remove_leftovers()
    assert files(store) == []


@pytest.mark.parametrize("keep", [0, 4, 60, -1])
def test_a_truncated_entry_counts_as_absent_and_is_logged(store, caplog, keep):
    store.write("clip", "a.jpg", entry(), SETTINGS)
    path = store.path("clip", "a.jpg")
    path.write_bytes(path.read_bytes()[:keep])
    assert not store.is_current("clip", "a.jpg", SETTINGS)
    assert "a.jpg" in caplog.text
    with pytest.raises(UserError, match=r"a\.jpg.*damaged"):
        store.read("clip", "a.jpg")


def test_a_foreign_file_counts_as_absent(store):
    from safetensors.torch import save_file

    path = store.path("clip", "a.jpg")
    path.parent.mkdir(parents=True)
    save_file(entry(), path)
    assert not store.is_current("clip", "a.jpg", SETTINGS)


def test_an_absent_entry_is_a_users_error_that_says_what_to_run(store):
    with pytest.raises(UserError, match=r"clip of b\.jpg is not prepared.*lang3dxl prepare"):
        store.read("clip", "b.jpg")


def test_writers_of_one_entry_never_mix_and_readers_never_see_a_part(store):
    """Eight writers, each with its own constant, while this thread reads."""
    store.write("clip", "a.jpg", {"features": torch.zeros(20_000)}, {"writer": 0})
    problems = []

    def write(number):
        try:
            for _ in range(5):
                tensors = {"features": torch.full((20_000,), float(number))}
                store.write("clip", "a.jpg", tensors, {"writer": number})
        except Exception as error:
            problems.append(error)

    writers = [threading.Thread(target=write, args=(number,)) for number in range(8)]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        assert len(store.read("clip", "a.jpg")["features"].unique()) == 1
    assert problems == []
    (final,) = store.read("clip", "a.jpg")["features"].unique().tolist()
    assert store.is_current("clip", "a.jpg", {"writer": int(final)})
    assert len(files(store)) == 1


def test_a_reader_keeps_its_entry_while_it_is_replaced(store):
    store.write("clip", "a.jpg", entry(), SETTINGS)
    held = store.read("clip", "a.jpg")["features"]
    store.write("clip", "a.jpg", entry(1), SETTINGS)
    assert torch.equal(held, entry()["features"].half())
    assert torch.equal(store.read("clip", "a.jpg")["features"], entry(1)["features"].half())


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_reading_a_slice_does_not_load_the_entry(store):
    store.write("dense", "a.jpg", {"features": torch.zeros(8192, 4096, dtype=torch.half)}, {})  # 64 MiB

    def resident():
        """Bytes of the entry's file that are in this process's memory."""
        path, total, inside = str(store.path("dense", "a.jpg")), 0, False
        for line in Path("/proc/self/smaps").read_text().splitlines():
            if re.match(r"[0-9a-f]+-[0-9a-f]+ ", line):
                inside = line.endswith(path)
            elif inside and line.startswith("Rss:"):
                total += int(line.split()[1]) * 1024
        return total

    features = store.read("dense", "a.jpg")["features"]
    assert resident() < 8 * 2**20
    assert features[4096].sum() == 0
    assert resident() < 8 * 2**20
    assert features.sum() == 0
    assert resident() > 60 * 2**20  # the measurement does see accessed pages


def test_an_entry_with_a_flipped_bit_or_without_its_checksum_is_damaged(store, caplog):
    from safetensors.torch import save_file

    store.write("clip", "a.jpg", entry(), SETTINGS)
    path = store.path("clip", "a.jpg")
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)
    assert not store.is_current("clip", "a.jpg", SETTINGS)
    assert "its checksum differs" in caplog.text
    save_file({"x": torch.ones(2)}, path, {"settings": '{"made": "before checksums"}'})
    assert not store.is_current("clip", "a.jpg", {"made": "before checksums"})


def test_an_altered_entry_is_found_whatever_its_time(store):
    """Archives and some disks keep times in whole seconds."""
    store.write("clip", "a.jpg", entry(), SETTINGS)
    path = store.path("clip", "a.jpg")
    assert store.is_current("clip", "a.jpg", SETTINGS)
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))
    os.utime(path, (1_700_000_000, 1_700_000_000))
    assert not store.is_current("clip", "a.jpg", SETTINGS)


def photo(path, content=b"1"):
    path.write_bytes(content)
    return Photo(path.name, path, None, Lens(4, 3, 5.0, 5.0, 2.0, 1.5))


def test_photos_are_hashed_once_and_again_only_when_their_files_change(store, tmp_path, monkeypatch):
    photos = [photo(tmp_path / name, name.encode()) for name in ("a.png", "b.png", "gone.png")]
    photos[2].path.unlink()
    read, content_hash = [], Photo.content_hash
    monkeypatch.setattr(Photo, "content_hash", lambda self: read.append(self.name) or content_hash(self))
    first = store.photo_hashes(photos)
    assert (first["a.png"], first["b.png"]) == (content_hash(photos[0]), content_hash(photos[1]))
    assert "gone.png" in str(first["gone.png"])
    assert sorted(read) == ["a.png", "b.png"]
    assert store.photo_hashes(photos).keys() == first.keys() and len(read) == 2
    photo(tmp_path / "b.png", b"another")
    assert store.photo_hashes(photos)["b.png"] == content_hash(photos[1]) != first["b.png"]
    assert read[2:] == ["b.png"]
    (store.root / "photo_hashes.json").write_text("[damaged")
    assert store.photo_hashes(photos)["a.png"] == first["a.png"]


def test_files_of_others_in_the_folder_are_never_deleted(store):
    """Such as the photos themselves, where the store's folder is theirs."""
    names = ("images/0001.jpg", "masks/0001.png", "models/clip.safetensors", "notes/draft.tmp")
    for path in map(store.root.joinpath, names):
        path.parent.mkdir(parents=True)
        path.write_bytes(b"mine")
        os.utime(path, (0, 0))
    store.remove_leftovers()
    assert all(store.root.joinpath(name).is_file() for name in names)
