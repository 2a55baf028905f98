"""Reading files of strangers: regular ones of a sensible size, and nothing else."""

import os
import struct

import numpy as np
import pytest
import torch

from lab.stages import MeasuredStages
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded, open_file, read_array, read_json, read_names, read_text


def test_what_was_written_is_read(tmp_path):
    (tmp_path / "a").write_text('{"é": 1}')
    assert read_text(tmp_path / "a") == '{"é": 1}'
    assert read_json(tmp_path / "a") == {"é": 1}
    np.save(tmp_path / "b.npy", np.arange(6.0).reshape(2, 3))
    assert (read_array(tmp_path / "b.npy") == np.arange(6).reshape(2, 3)).all()


def test_lists_saved_by_windows_and_names_with_a_hash_are_read(tmp_path):
    (tmp_path / "list.txt").write_bytes("\ufeff0001.jpg\r\nIMG#2.jpg  # blurred\r\n# none\r\n\r\n".encode())
    assert read_names(tmp_path / "list.txt") == ("0001.jpg", "IMG#2.jpg")
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf[1]")
    assert read_json(tmp_path / "a.json") == [1]


def test_pipes_devices_and_folders_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, "/dev/zero"):
        for read in (open_file, read_text, read_json, read_array):
            with pytest.raises(OSError, match="not a regular file"):
                read(type(tmp_path)(path))
    with pytest.raises(UserError, match="can't be read"):
        read_names(tmp_path / "pipe")


@pytest.mark.parametrize("content", [b"[" * 100_000, b"\xff", b"", b"[1", b"9" * 2_000_000])
def test_other_content_is_one_kind_of_error(tmp_path, content):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(ValueError, match=r"\w"):
        read_json(tmp_path / "a", most=1 << 20)


def npy(header: str, data: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + data


@pytest.mark.parametrize(
    "content",
    [
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': (100000000, 100000), }"),
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': " + "(" * 3000 + ", }"),
        npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", bytes(8)),
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }", bytes(8)),
        npy("3"),
        b"PK\x03\x04",
        b"",
    ],
)
def test_arrays_whose_header_does_not_fit_are_refused(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(ValueError, match="header"):
        read_array(tmp_path / "a.npy")


def test_the_home_of_nobody_is_one_sentence():
    with pytest.raises(UserError, match="no such user"):
        expanded("~nosuchuser/scene")


@pytest.mark.parametrize("content", ["", "[]", '{"train": 3}', '{"train": {"seconds": "a"}}', "[" * 9999])
def test_damaged_figures_of_earlier_stages_are_forgotten(tmp_path, content):
    (tmp_path / "stages.json").write_text(content)
    assert MeasuredStages({"train": 1.0}, tmp_path / "stages.json").figures() == {
        "seconds": {},
        "peak_mb": {},
    }


@pytest.mark.parametrize("full", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_no_file_is_blamed_for_a_full_memory(full, tmp_path, monkeypatch):
    """Every reader that calls errors of its libraries damage lets a full memory through."""
    import safetensors
    from painted_scene import painted_scene
    from PIL import Image

    from lang3dxl_ns.common.errors import readable
    from lang3dxl_ns.common.pictures import open_picture
    from lang3dxl_ns.files.read_splats import read_splats
    from lang3dxl_ns.files.scene_file import read_scene, write_scene
    from lang3dxl_ns.plugin.run_checkpoint import read_checkpoint

    def fails(*_, **__):
        raise full

    write_scene(tmp_path / "a.scene", painted_scene())
    painted_scene().export(tmp_path / "a.ply")
    torch.save({"pipeline": {}, "step": 1}, tmp_path / "a.ckpt")
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    with pytest.raises(type(full)), readable("x is damaged", "copy it"):
        fails()
    with pytest.raises(type(full)), open_picture(tmp_path / "a.png"):
        fails()
    monkeypatch.setattr(safetensors, "safe_open", fails)
    monkeypatch.setattr(np, "frombuffer", fails)
    monkeypatch.setattr(np, "fromfile", fails)
    monkeypatch.setattr(torch, "load", fails)
    for read, name in ((read_scene, "a.scene"), (read_splats, "a.ply"), (read_checkpoint, "a.ckpt")):
        with pytest.raises(type(full)):
            read(tmp_path / name)
