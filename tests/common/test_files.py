"""Atomic file writes."""

import errno
import os
import stat
from functools import partial

import pytest

from lang3dxl_ns.common.checks import disk_trouble
from lang3dxl_ns.common.files import file_locked, replace_durably, set_aside, write_atomically


def lock(path):
    with file_locked(path):
        pass


def test_a_failed_write_leaves_the_old_file_and_no_temporary(tmp_path, monkeypatch):
    target = tmp_path / "figure.png"
    write_atomically(target, b"old")

    def refuse(*_):
        raise OSError(errno.ENOSPC, "disk full")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(target, b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]
    assert target.read_bytes() == b"old"


def test_what_replaces_a_file_is_on_the_disk_before(tmp_path, monkeypatch):
    """A loss of power after the renaming, and before the content is written, would leave neither."""
    calls, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: calls.append("fsync") or fsync(file))
    monkeypatch.setattr(os, "replace", lambda *names: calls.append("replace") or replace(*names))
    (tmp_path / "partial").write_text("new")
    replace_durably(tmp_path / "partial", tmp_path / "a.ckpt")
    write_atomically(tmp_path / "b.json", "new")
    assert calls == ["fsync", "replace", "fsync", "fsync", "replace"]
    assert (tmp_path / "a.ckpt").read_text() == (tmp_path / "b.json").read_text() == "new"


def test_a_disk_that_syncs_no_folder_takes_a_checkpoint(tmp_path, monkeypatch):
    """As shares, and folders of Windows under Linux."""
    fsync = os.fsync

    def of_files(file):
        if stat.S_ISDIR(os.fstat(file).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(file)

    monkeypatch.setattr(os, "fsync", of_files)
    (tmp_path / "partial").write_text("new")
    replace_durably(tmp_path / "partial", tmp_path / "a.ckpt")
    assert [path.name for path in tmp_path.iterdir()] == ["a.ckpt"]


def test_a_device_or_a_pipe_is_written_to_and_a_link_stays_a_link(tmp_path):
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to(tmp_path / "target")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_atomically(pipe, "words")
    assert pipe.is_fifo()
    assert os.read(reader, 100) == b"words"
    os.close(reader)
    write_atomically(link, "words")
    assert link.is_symlink()
    assert (tmp_path / "target").read_text() == "words"
    with pytest.raises(IsADirectoryError):
        write_atomically(tmp_path, "words")


@pytest.mark.parametrize("change", [partial(write_atomically, content=""), set_aside, lock])
def test_links_in_a_circle_are_told_with_what_helps_and_stay(tmp_path, change):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(OSError, match="symbolic links") as error:
        change(tmp_path / "a")
    assert "remove them" in disk_trouble(error.value)
    assert (tmp_path / "a").is_symlink() and (tmp_path / "b").is_symlink()


@pytest.mark.parametrize(
    ("number", "told"),
    [
        (errno.EFBIG, "FAT32: 4 GB"),
        (errno.EMFILE, "ulimit -n"),
        (errno.EINVAL, "choose another place or name"),
        (errno.EHOSTDOWN, "choose another place or name"),
    ],
)
def test_whatever_a_system_says_of_a_file_is_told_with_its_name(number, told):
    """Disks and shares have many reasons: exFAT takes no colon in a name, FAT32 no file of 4 GB."""
    message = disk_trouble(OSError(number, os.strerror(number), "a:b.ply"))
    assert message.startswith("a:b.ply: ") and told in message
    assert disk_trouble(OSError(number, os.strerror(number))) is None  # of no file
    assert disk_trouble(OSError("of a library")) is None


@pytest.mark.parametrize("letter", ["a", "é", "🏰"])
def test_a_file_whose_name_fills_what_the_disk_allows_is_written(tmp_path, letter):
    """As names of downloads that hold a whole sentence."""
    name = letter * ((255 - 4) // len(letter.encode())) + ".jpg"
    write_atomically(tmp_path / name, "words")
    assert [path.name for path in tmp_path.iterdir()] == [name]
