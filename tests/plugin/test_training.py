"""Training, evaluation and resume through nerfstudio's own trainer."""

import json
from functools import partial
from pathlib import Path

import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from runs import train_run

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer


@pytest.fixture
def train(train):
    """With codes that are trained with the scene."""
    return partial(train, pipeline__model__decoder__name="paper")


@pytest.fixture(scope="module")
def finished(scene, tiny_clip, tiny_dense, tmp_path_factory):
    """A finished run of six steps, to look at."""
    folder = tmp_path_factory.mktemp("finished")
    changes = {"pipeline__model__decoder__name": "paper"}
    return train_run(scene, tiny_clip, tiny_dense, folder, iterations=6, **changes)


def parameters(trainer) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in trainer.pipeline.model.named_parameters() if p.numel()}


def test_every_parameter_learns_and_the_loss_falls(train, scene):
    trainer = train(scene, iterations=1)
    before = parameters(trainer)
    trainer = train(scene, iterations=24)
    after = parameters(trainer)
    still = [name for name in after if torch.equal(before[name], after[name][: len(before[name])])]
    # Harmonics of degree 1 and up open later; everything else has moved.
    assert set(still) <= {"gauss_params.features_rest"}
    assert all(torch.isfinite(value).all() for value in after.values())


def test_without_clip_there_is_nothing_semantic(train, scene):
    model = train(scene, iterations=2, semantics=False).pipeline.model
    assert "codes" not in model.gauss_params
    assert model.semantic_field is None and model.downsampler is None
    assert not (scene / "none").exists()


def test_semantics_leave_colors_and_geometry_as_they_are(train, scene):
    """Joint training moves Gaussians exactly as color-only training does."""
    joint, alone = (parameters(train(scene, iterations=12, semantics=s)) for s in (True, False))
    for name in ("means", "scales", "quats", "features_dc", "opacities"):
        torch.testing.assert_close(joint[f"gauss_params.{name}"], alone[f"gauss_params.{name}"])


def test_feature_gradient_reaches_geometry_only_on_request(train, scene, finished):
    plain = parameters(finished)
    coupled = parameters(train(scene, iterations=6, pipeline__model__feature_gradient_to_geometry=True))
    assert not torch.equal(plain["gauss_params.means"], coupled["gauss_params.means"])


def test_torch_trains_what_the_compiled_kernels_train(train, scene, monkeypatch):
    """Where numba is missing, torch takes their place; all other tests of training take the kernels."""
    found = []
    for kernels in ("numba", "torch"):
        monkeypatch.setenv("LANG3DXL_CPU_KERNELS", kernels)
        losses = train(scene, iterations=2).pipeline.last_losses  # more, and Adam turns rounding into signs
        found.append({name: loss.item() for name, loss in losses.items()})
    assert {"rgb", "clip", "dense"} <= set(found[0])
    assert found[0] == pytest.approx(found[1], rel=1e-5)


def test_densification_carries_the_codes(train, scene):
    trainer = train(scene, iterations=20, pipeline__model__densify_grad_thresh=1e-7)
    model = trainer.pipeline.model
    assert model.num_points > 400
    assert {len(p) for p in model.gauss_params.values()} == {model.num_points}


def test_what_is_kept_of_a_step_keeps_nothing_that_it_computed(train, scene, monkeypatch):
    """nerfstudio holds a step's losses and metrics through the next one; a graph would hold its images."""
    results, step = [], Lang3DXLTrainer.train_iteration
    monkeypatch.setattr(
        Lang3DXLTrainer, "train_iteration", lambda *args: results.append(step(*args)) or results[-1]
    )
    trainer = train(scene, iterations=1)
    loss, losses, metrics = results[0]
    kept = [loss, *losses.values(), *metrics.values(), *trainer.pipeline.last_losses.values()]
    assert len(kept) > 4 and all(value.grad_fn is None for value in kept)


def test_warm_up_trains_no_code(train, scene):
    options = {"pipeline__model__warm_up": 0.5, "pipeline__model__densify_until": 0.0}
    warm = train(scene, iterations=20, **options)
    halfway = train(scene, iterations=20, **options | {"pipeline__model__warm_up": 2.0})
    initial = halfway.pipeline.model.semantic_field.settings.code_std
    assert (
        float(halfway.pipeline.model.gauss_params["codes"].std()) < 2 * initial
    )  # the warm-up never ended: no code has moved
    assert float(warm.pipeline.model.gauss_params["codes"].std()) > 2 * initial


def test_codes_from_photos_say_at_once_what_noise_has_to_learn(train, scene):
    def clip_loss(start: str) -> float:
        settings = {"codes_from": start, "warm_up": 0.9, "semantic_ramp": 0.0}
        settings["decoder__compression__steps"] = 40
        changes = {f"pipeline__model__{name}": value for name, value in settings.items()}
        changes["pipeline__datamanager__crops"] = "pyramid"  # the same targets from both starts
        return float(train(scene, iterations=20, **changes).pipeline.last_losses["clip"])

    # After two steps noise decodes to little but the mean feature.
    assert clip_loss("photos") < 0.95 * clip_loss("noise")


def test_evaluation_of_a_checkpoint_gives_what_the_trainer_gave(finished):
    expected = finished.pipeline.get_average_eval_image_metrics()
    _, pipeline, _, _ = eval_setup(finished.base_dir / "config.yml")
    metrics = pipeline.get_average_eval_image_metrics(get_std=True)
    for name in ("psnr", "ssim", "clip_l1", "clip_psnr", "clip_cosine", "clip_l1_of_mean", "dense_l1"):
        assert metrics[name] == pytest.approx(expected[name], rel=1e-4), name
    assert "lpips" not in metrics  # no weights offline
    json.dumps(metrics, allow_nan=False)


def test_checkpoint_of_another_clip_is_refused(train, scene, finished, tmp_path):
    from tiny_models import make_tiny_clip

    other = make_tiny_clip(tmp_path / "other_clip", dim=48)
    with pytest.raises(UserError, match="width 64, but the prepared targets have 48"):
        train(scene, iterations=8, load_dir=finished.checkpoint_dir, pipeline__datamanager__clip=str(other))


def test_config_is_complete_and_readable_from_any_folder(finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config, pipeline, _, step = eval_setup(Path(finished.base_dir / "config.yml"), test_mode="inference")
    assert step == 5
    assert config.pipeline.model.semantic_field.preset == "short"
    assert pipeline.model.num_points > 0


def test_a_panorama_is_refused_in_files_and_told_of_once_in_a_viewer(finished, capsys):
    for mode in ("inference", "test"):
        _, pipeline, _, _ = eval_setup(finished.base_dir / "config.yml", test_mode=mode)
        camera = pipeline.datamanager.train_dataset.cameras[:1]
        camera.camera_type[:] = CameraType.EQUIRECTANGULAR.value
        capsys.readouterr()
        if mode == "inference":  # ns-render
            with pytest.raises(UserError, match="not as equirectangular: choose"):
                pipeline.model.get_outputs_for_camera(camera)
        else:
            assert [pipeline.model.get_outputs_for_camera(camera)["rgb"].ndim for _ in "ab"] == [3, 3]
            assert capsys.readouterr().out.count("not as equirectangular") == 1


def first_batch(trainer):
    """Of a trained model: camera and batch of a training photo, and what the model makes of the camera."""
    camera, batch = trainer.pipeline.datamanager.next_train(0)
    model = trainer.pipeline.model.train()
    return batch, model, model.get_outputs(camera)


def test_regions_are_a_loss_where_they_are_asked_for_and_nothing_at_all_elsewhere(train, scene, finished):
    batch, model, outputs = first_batch(finished)
    assert "regions" not in batch
    assert "regions" not in model.get_loss_dict(outputs, batch)
    batch, model, outputs = first_batch(
        train(scene, iterations=2, pipeline__datamanager__regions="felzenszwalb")
    )
    assert batch["regions"].dtype == torch.int64
    loss = model.get_loss_dict(outputs, batch)["regions"]
    assert 0 < loss.item() < float("inf")
    (gradient,) = torch.autograd.grad(loss, model.gauss_params["codes"])
    assert gradient.abs().max() > 0


def test_the_mask_bounds_the_region_loss_and_as_published_not_the_dense_one(train, scene, tmp_path):
    """Labels that differ only outside the mask, the left half, give the same loss; queries see the mask."""
    for path in (scene / "images").iterdir():
        with Image.open(path) as photo:
            width, height = photo.size
        mask = Image.new("L", (width, height), 0)
        mask.paste(255, (width // 2, 0, width, height))
        (tmp_path / "right").mkdir(exist_ok=True)
        mask.save(tmp_path / "right" / f"{path.stem}.png")
    options = {"regions": "felzenszwalb", "foreground": str(tmp_path / "right")}
    trainer = train(
        scene, iterations=2, **{f"pipeline__datamanager__{name}": value for name, value in options.items()}
    )
    batch, model, outputs = first_batch(trainer)
    photo = trainer.pipeline.datamanager.data.photos[batch["name"]]
    assert torch.equal(photo.read_mask(), batch["mask"][..., 0])
    assert 0.4 < batch["mask"].float().mean() < 0.6
    before = model.get_loss_dict(outputs, batch)
    changes = {"dense_target": 100.0, "regions": 7}  # far from the border, which resizing blurs
    for where, same in ((slice(None, 0.4), True), (slice(0.6, None), False)):
        changed = dict(batch)
        for key, value in changes.items():
            width = batch[key].shape[1]
            start, stop = (None if at is None else round(at * width) for at in (where.start, where.stop))
            changed[key] = batch[key].clone()
            changed[key][:, start:stop] = value
        after = model.get_loss_dict(outputs, changed)
        assert torch.allclose(after["regions"], before["regions"], rtol=1e-5, atol=0) is same
        assert not torch.allclose(after["dense"], before["dense"], rtol=1e-5, atol=0)


def test_masked_pixels_have_no_effect(train, scene, tmp_path):
    """Photos that differ only outside the mask train the same model."""
    import shutil

    import numpy as np

    results = []
    for paint in (0, 255):
        folder = tmp_path / f"scene{paint}"
        shutil.copytree(scene, folder, ignore=shutil.ignore_patterns("lang3dxl_cache"))
        for path in (folder / "images").iterdir():
            pixels = np.array(Image.open(path))
            mask = np.full(pixels.shape[:2], 255, dtype=np.uint8)
            mask[:, : pixels.shape[1] // 4] = 0
            pixels[mask == 0] = paint
            (folder / "masks").mkdir(exist_ok=True)
            Image.fromarray(pixels).save(path.with_suffix(".png"))
            path.unlink()
            path.with_suffix(".png").rename(path)
            Image.fromarray(mask).save(folder / "masks" / f"{path.stem}.png")
        # SSIM sees whole images, as published; L1 alone must not.
        trainer = train(folder, iterations=5, semantics=False, pipeline__model__ssim_lambda=0.0)
        results.append(parameters(trainer)["gauss_params.features_dc"])
    torch.testing.assert_close(results[0], results[1])
