"""Training runs of the baselines."""

from functools import cache

import pytest
import torch
from runs import train_run
from scenes import write_scene
from tiny_models import make_tiny_clip, make_tiny_dinov2

from lab.baselines import BASELINES, langsplat
from lang3dxl_ns.components.decoders import DecoderConfig
from lang3dxl_ns.evaluation.score_run import score_features
from lang3dxl_ns.plugin.cameras import photo_camera
from lang3dxl_ns.plugin.trainer_config import open_run
from lang3dxl_ns.rendering import composite
from lang3dxl_ns.training.snapshot import snapshot


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The finished short run of a baseline by name, "none" for colors alone; each is made once."""
    root = tmp_path_factory.mktemp("baselines")
    data = write_scene(root / "scene", photos=12, points=400, mixed=True)
    clip, dense = make_tiny_clip(root / "clip"), make_tiny_dinov2(root / "dinov2")

    @cache
    def made(name: str):
        decoder = DecoderConfig() if name == "none" else DecoderConfig(name)
        changes = {"pipeline__model__decoder": decoder}
        return train_run(data, clip, dense, root / name, 6, name != "none", **changes)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(langsplat, "_STEPS", 20)
        yield made


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_trains_gives_features_of_the_targets_width_and_is_the_same_once_loaded(run, name):
    trainer = run(name)
    model = trainer.pipeline.model.eval()
    camera, batch = next(iter(trainer.pipeline.datamanager.fixed_indices_eval_dataloader))
    _, images = model.get_image_metrics_and_images(model.get_outputs_for_camera(camera), batch)
    assert model.semantic_field.decode_clip(model.run.carried).shape[-1] == batch["clip_target"].shape[-1]
    assert images["bottleneck"].shape[-1] == 3
    state, view = model.run, photo_camera(camera).camera()
    scene, side = snapshot(state, trainer.pipeline.datamanager.data.record()), model.config.decode_size[1]
    metrics = score_features(scene, state.parts.semantics, view, batch, side)
    assert metrics["clip_l1"] < 10 and ("dense_l1" in metrics) is (name not in ("langsplat", "lifting"))
    loaded = open_run(trainer.base_dir)[1].model.eval()
    with torch.no_grad():
        maps = [composite(m.run.splats(), view, m.run.carried.nan_to_num(7.0)) for m in (loaded, model)]
    torch.testing.assert_close(*maps)


@pytest.mark.parametrize("name", ["feature3dgs", "fmgs", "direct"])
def test_what_a_baseline_trains_moves_and_geometry_is_left_to_the_colors(run, name):
    alone, model = run("none").pipeline.model, run(name).pipeline.model
    torch.testing.assert_close(model.means, alone.means)
    if "codes" in model.gauss_params:
        assert model.gauss_params["codes"].abs().max() > 0
    trained = [p for group in model.semantic_field.parameter_groups().values() for p in group]
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in trained)


def test_only_fmgs_has_an_alignment_loss(run):
    for name in ("direct", "fmgs"):
        assert ("alignment" in run(name).pipeline.last_losses) is (name == "fmgs")


def test_lifted_features_come_near_the_targets_and_nothing_is_learned_before(run):
    trainer = run("lifting")
    assert set(trainer.pipeline.last_losses) == {"rgb"}
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    assert metrics["clip_l1"] < metrics["clip_l1_of_mean"] * 1.5
