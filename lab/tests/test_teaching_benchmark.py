"""`lang3dxl benchmark teaching` on a scene with known answers."""

import json
from dataclasses import replace

import numpy as np
import torch
from painted_scene import CHANNELS, DOME, encode_texts, painted_file, painted_scene
from PIL import Image

from lab.baselines.lifting import LiftedFeatures
from lang3dxl_ns.cli import main
from lang3dxl_ns.files.scene_file import write_scene


def label(photo, folder) -> None:
    """A mask of the dome in a photo, in the layout `plain`."""
    camera = photo.full_camera
    corners = torch.tensor([[DOME[0], DOME[2], 0, 1.0], [DOME[1], DOME[3], 0, 1]])
    seen = camera.intrinsics @ (camera.view_matrix @ corners.T)[:3]
    (left, right), (top, bottom) = (seen[:2] / seen[2]).round().int().clamp(0, 96).tolist()
    mask = np.zeros((96, 96), np.uint8)
    mask[top:bottom, left:right] = 255
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(folder / f"{photo.name.partition('/')[2].removesuffix('.jpg')}.png")


def test_a_word_shown_once_scores_above_its_unknown_text(tmp_path, monkeypatch):
    monkeypatch.setattr("lang3dxl_ns.query.scene.text_encoder", lambda file, device: encode_texts)
    decoder = LiftedFeatures(CHANNELS, 0)
    decoder.name = "lifting"
    codes = torch.nan_to_num(painted_scene().codes)
    codes = torch.cat([codes, torch.ones(len(codes), 1)], 1)
    file = replace(painted_file(), data="wall")
    write_scene(tmp_path / "wall.scene", painted_scene(decoder=decoder, codes=codes, file=file))
    for photo in file.photos[1:]:
        label(photo, tmp_path / "truth" / "gizmo")
    flags = ("--ground-truth", str(tmp_path / "truth"), "--out", str(tmp_path), "--draws", "1")
    main(["benchmark", "teaching", str(tmp_path / "wall.scene"), *flags])
    found = json.loads((tmp_path / "teaching.json").read_text())
    rows = found["words"]["gizmo"]
    assert rows["outline, 1 photo"]["ap"] > 0.9 > rows["text"]["ap"]
    assert rows["outline, 1 photo"]["iou"] > 0.7
    assert found["teach_seconds"] > 0
    assert "| box, 2 photos |" in (tmp_path / "teaching.md").read_text()
