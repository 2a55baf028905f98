"""Training runs of the decoders. lab/tests/test_baselines.py has those of the laboratory."""

from functools import cache

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from runs import train_run

from lang3dxl_ns.components.decoders import DecoderConfig
from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig
from lang3dxl_ns.evaluation.score_run import score_features
from lang3dxl_ns.plugin.cameras import photo_camera
from lang3dxl_ns.rendering import composite
from lang3dxl_ns.training.snapshot import snapshot


@pytest.fixture(scope="module")
def run(scene, tiny_clip, tiny_dense, tmp_path_factory):
    """The finished short run of a decoder by name; each is made once."""

    @cache
    def made(name: str, dense: bool = True):
        changes = {"pipeline__model__decoder": DecoderConfig(name, CompressionConfig(steps=40, batch=512))}
        if not dense:
            changes["pipeline__datamanager__dense"] = "none"
        return train_run(scene, tiny_clip, tiny_dense, tmp_path_factory.mktemp(name), 6, **changes)

    return made


@pytest.mark.parametrize("name", ["gathered", "paper"])
def test_a_decoder_trains_gives_features_of_the_targets_width_and_is_the_same_once_loaded(run, name):
    trainer = run(name)
    model = trainer.pipeline.model.eval()
    camera, batch = next(iter(trainer.pipeline.datamanager.fixed_indices_eval_dataloader))
    _, images = model.get_image_metrics_and_images(model.get_outputs_for_camera(camera), batch)
    assert model.semantic_field.decode_clip(model.run.carried).shape[-1] == batch["clip_target"].shape[-1]
    assert images["bottleneck"].shape[-1] == 3
    run, data = model.run, trainer.pipeline.datamanager.data
    side, view = model.config.decode_size[1], photo_camera(camera).camera()
    metrics = score_features(snapshot(run, data.record()), run.parts.semantics, view, batch, side)
    assert metrics["clip_l1"] < 10 and ("dense_l1" in metrics) is (name == "paper")
    _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml", test_mode="inference")
    loaded = pipeline.model.eval()
    with torch.no_grad():
        maps = [composite(m.run.splats(), view, m.run.carried.nan_to_num(7.0)) for m in (loaded, model)]
    torch.testing.assert_close(*maps)


def test_gathered_features_come_near_the_targets_and_nothing_is_learned_before(run):
    trainer = run("gathered")
    assert set(trainer.pipeline.last_losses) == {"rgb"}
    datamanager = trainer.pipeline.datamanager
    assert set(datamanager.next_train(0)[1]) == {"image", "image_idx", "name"}  # no step waits for a target
    assert {"clip_target", "dense_target"} < set(next(datamanager.data.every_photo())[1])
    assert not any("dense_target" in batch for _, batch in datamanager.fixed_indices_eval_dataloader)
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    assert metrics["clip_l1"] < metrics["clip_l1_of_mean"] * 1.5
    assert not trainer.pipeline.model.gauss_params["codes"].requires_grad


def test_dense_features_sharpen_words_and_leave_all_else_as_it_is(run):
    sharp, without = (dict(run("gathered", dense).pipeline.model.gauss_params) for dense in (True, False))
    codes, others = sharp.pop("codes"), without.pop("codes")
    assert codes.shape == others.shape and (codes != others).any()
    for name, value in sharp.items():
        assert torch.equal(value, without[name]), name


@pytest.mark.parametrize(
    "field", [SemanticFieldConfig("short", levels=0), SemanticFieldConfig("short", code_dim=6)]
)
def test_fields_of_the_ablation_train(train, scene, field):
    trainer = train(
        scene, iterations=3, pipeline__model__decoder__name="paper", pipeline__model__semantic_field=field
    )
    assert torch.isfinite(trainer.pipeline.last_losses["clip"])


@pytest.mark.parametrize("match", ["resize-features", "resize-target"])
def test_without_the_downsampler_codes_learn_all_the_same(train, scene, match):
    trainer = train(
        scene, iterations=3, pipeline__model__decoder__name="paper", pipeline__model__downsampler__match=match
    )
    assert trainer.pipeline.model.gauss_params["codes"].grad.abs().max() > 0
    assert trainer.pipeline.model.downsampler.network is None
