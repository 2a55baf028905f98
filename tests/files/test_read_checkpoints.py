"""Checkpoints of gsplat and splatfacto: one scene, however it is stored; and files that are none."""

import pickle

import numpy as np
import pytest
import torch
from made_splats import assert_alike, gsplat_state, some_splats
from moved_splats import with_colors

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.activations import log_scales, logits
from lang3dxl_ns.files.read_splats import read_splats
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.training.checkpoint import load_checked


def splatfacto_state(splats: Splats) -> dict:
    parts = {"means": splats.means, "scales": log_scales(splats), "quats": splats.quats}
    parts |= {"opacities": logits(splats)[:, None], "features_dc": splats.harmonics[:, 0]}
    parts |= {"features_rest": splats.harmonics[:, 1:]}
    return {"step": 9, "pipeline": {f"_model.gauss_params.{name}": value for name, value in parts.items()}}


def test_checkpoints_of_gsplat_and_splatfacto_are_read(tmp_path):
    splats = some_splats(bands=16)
    torch.save(gsplat_state(splats), tmp_path / "ckpt_29999_rank0.pt")
    assert_alike(read_splats(tmp_path / "ckpt_29999_rank0.pt"), splats)
    (tmp_path / "nerfstudio_models").mkdir()
    torch.save(splatfacto_state(splats), tmp_path / "nerfstudio_models" / "step-000000009.ckpt")
    (tmp_path / "config.yml").write_text("!!python/object:any.Thing\nrasterize_mode: antialiased\n")
    found = read_splats(tmp_path)
    assert_alike(found, splats)
    assert found.antialiased


def test_a_checkpoint_that_holds_numpy_scalars_is_read(tmp_path):
    """As learning rates of schedulers are."""
    splats = some_splats()
    rates = {"lr": np.float64(0.1), "steps": [np.int32(3), np.float32(2)], "big": np.dtype(">f8").type(1)}
    torch.save(splatfacto_state(splats) | {"optimizers": rates}, tmp_path / "step-1.ckpt")
    assert_alike(read_splats(tmp_path / "step-1.ckpt"), splats)
    torch.save(gsplat_state(splats) | {"rate": rates["lr"]}, tmp_path / "a.pt")
    assert_alike(read_splats(tmp_path / "a.pt"), splats)
    with pytest.raises(pickle.UnpicklingError):  # elsewhere they stay refused
        torch.load(tmp_path / "a.pt", weights_only=True)


def test_a_splatfacto_of_one_color_per_gaussian_stores_logits_of_it(tmp_path):
    splats = some_splats(bands=1)
    colors = (splats.harmonics[:, 0] * 0.28209479 + 0.5).clamp(0.01, 0.99)
    state = splatfacto_state(with_colors(splats, colors))
    state["pipeline"]["_model.gauss_params.features_dc"] = colors.logit()
    torch.save(state, tmp_path / "step-1.ckpt")
    torch.testing.assert_close(read_splats(tmp_path / "step-1.ckpt").colors(torch.zeros(3)), colors)


def test_checkpoints_in_the_old_format_and_of_other_shapes_are_told(tmp_path):
    state = gsplat_state(some_splats(20))
    torch.save(state, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(UserError, match=r"old\.pt: it is not a checkpoint of torch 1\.6 or later: save it"):
        read_splats(tmp_path / "old.pt")
    state["splats"]["quats"] = state["splats"]["quats"][:, :3]
    torch.save(state, tmp_path / "flat.pt")
    with pytest.raises(UserError, match=r"flat\.pt.*\[3, 3, 3, 3\] numbers a Gaussian"):
        read_splats(tmp_path / "flat.pt")


def test_a_checkpoint_of_several_gpus_is_read_whole_without_copies_of_its_files(tmp_path, capsys):
    splats = some_splats()
    for rank, part in enumerate((splats.select(torch.arange(100)), splats.select(torch.arange(100, 300)))):
        for copy in ("", " (copy)", "_copy"):
            torch.save(gsplat_state(part), tmp_path / f"ckpt_6999_rank{rank}{copy}.pt")
    for file in ("ckpt_6999_rank0.pt", "ckpt_6999_rank1.pt"):
        assert_alike(read_splats(tmp_path / file), splats)
        assert "lies in 2 files" in capsys.readouterr().out


def test_a_checkpoint_of_gsplats_2dgs_is_flat(tmp_path):
    """It keeps a third scale, with which nothing was drawn."""
    splats = some_splats()
    (tmp_path / "ckpts").mkdir()
    torch.save(gsplat_state(splats), tmp_path / "ckpts" / "ckpt_29999.pt")
    (tmp_path / "cfg.json").write_text('{"data_factor": 4, "model_type": "2dgs"}')
    found = read_splats(tmp_path)
    torch.testing.assert_close(found.scales[:, :2], splats.scales[:, :2])
    assert bool((found.scales[:, 2] < 0.01 * found.scales[:, :2].amin(1)).all())


def test_older_names_in_checkpoints_are_read(tmp_path):
    splats, config = some_splats(), tmp_path / "cfg.yml"
    state = gsplat_state(splats)
    state["splats"]["means3d"] = state["splats"].pop("means")
    (tmp_path / "ckpts").mkdir()
    torch.save(state, tmp_path / "ckpts" / "a.pt")
    assert_alike(read_splats(tmp_path / "ckpts" / "a.pt"), splats)
    config.write_text("antialiased: true\n")
    assert read_splats(tmp_path / "ckpts" / "a.pt").antialiased
    state = splatfacto_state(splats)
    parts = {name.replace("gauss_params.", ""): value for name, value in state["pipeline"].items()}
    first, rest = parts.pop("_model.features_dc"), parts.pop("_model.features_rest")
    parts["_model.colors_all"] = torch.cat([first[:, None], rest], dim=1)
    torch.save({"pipeline": parts}, tmp_path / "b.ckpt")
    assert_alike(read_splats(tmp_path / "b.ckpt"), splats)


@pytest.mark.parametrize("part", ["means", "scales", "sh0"])
def test_a_checkpoint_that_names_numbers_it_does_not_hold_is_refused(part, tmp_path):
    state = gsplat_state(some_splats(9))
    state["splats"][part] = state["splats"][part].to("meta")
    torch.save(state, tmp_path / "a.pt")
    with pytest.raises(UserError, match=rf"{part} is larger than what is stored of it"):
        read_splats(tmp_path / "a.pt")
    torch.save({"tensors": state["splats"], "step": 1}, tmp_path / "b.pt")
    with pytest.raises(ValueError, match=rf"{part} is larger than what is stored of it"):
        load_checked(tmp_path / "b.pt", "tensors")


def test_a_checkpoint_of_another_program_is_told_with_the_way_out(tmp_path):
    torch.save(((3, torch.zeros(2, 3)), 30_000), tmp_path / "chkpnt30000.pth")
    with pytest.raises(UserError, match=r"other than gsplat and nerfstudio: give a \.ply"):
        read_splats(tmp_path / "chkpnt30000.pth")
