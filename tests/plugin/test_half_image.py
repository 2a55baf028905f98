"""The half-image protocol: what it sees, what it fits, and what it leaves alone."""

import pytest
import torch
from looks import in_look
from runs import train_run

from lang3dxl_ns.components.appearance import Look
from lang3dxl_ns.components.losses import rgb_loss
from lang3dxl_ns.evaluation.half_image import HalfImageProtocol
from lang3dxl_ns.evaluation.photo_metrics import corrected_psnr, psnr
from lang3dxl_ns.plugin.cameras import photo_camera

USE = "pipeline__model__appearance__use"
SHIFT = "pipeline__model__appearance__opacity_shift"


@pytest.fixture(scope="module", params=[False, True], ids=["colors", "opacities"])
def pipeline(request, scene, tmp_path_factory):
    """A run whose looks differ, in evaluation mode."""
    folder, shift = (
        tmp_path_factory.mktemp("half"),
        {"pipeline__model__appearance__opacity_shift": request.param},
    )
    trainer = train_run(scene, None, None, folder, 24, semantics=False, **{USE: "on"}, **shift)
    field = trainer.pipeline.model.appearance
    with torch.no_grad():
        field.vectors.mul_(10)
    trainer.pipeline.eval()
    return trainer.pipeline


@pytest.fixture
def photo(pipeline):
    """Camera and batch of a held-out photo."""
    return next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))


def protocol(model):
    background, weight = model._get_background_color(), model.config.ssim_lambda
    return HalfImageProtocol(model.run.splats(), model.appearance, model.image_metrics, background, weight)


def half_image(model, camera, batch):
    mask = batch["mask"][..., 0] if "mask" in batch else None
    return protocol(model).measure(photo_camera(camera).camera(), model.get_gt_img(batch["image"]), mask)


def fit_look(model, camera, left, steps):
    return protocol(model).fit(photo_camera(camera).camera(), left, steps=steps)


def halves(image):
    middle = image.shape[1] // 2
    return image[:, :middle], image[:, middle:]


@torch.no_grad()
def shown(model, camera, vector=None):
    return in_look(model, camera, None if vector is None else Look(model.appearance, vector)).rgb


def test_nothing_of_the_right_half_is_seen(pipeline, photo):
    camera, batch = photo
    batch = batch | {"mask": torch.ones_like(batch["image"][..., :1], dtype=torch.bool)}
    changed = batch | {"image": batch["image"].clone(), "mask": batch["mask"].clone()}
    halves(changed["image"])[1][:] = 255 - halves(changed["image"])[1]
    halves(changed["mask"])[1][:] = False
    (first, figures), (second, others) = (half_image(pipeline.model, camera, b) for b in (batch, changed))
    assert torch.equal(first, second)
    assert figures["half_psnr"] != others["half_psnr"]


def test_nothing_of_the_left_half_is_scored(pipeline, photo, monkeypatch):
    camera, batch = photo
    vector = pipeline.model.appearance.vectors[0].detach()
    monkeypatch.setattr(HalfImageProtocol, "fit", lambda *_: vector)
    changed = batch | {"image": batch["image"].clone()}
    halves(changed["image"])[0][:] = 0
    first, second = (half_image(pipeline.model, camera, b)[1] for b in (batch, changed))
    assert {**first, "fit_seconds": 0} == {**second, "fit_seconds": 0}
    _, right = halves(shown(pipeline.model, camera, vector))
    expected = psnr(right, halves(batch["image"] / 255)[1])
    assert first["half_psnr"] == pytest.approx(float(expected), abs=1e-3)


def test_what_a_photo_does_not_reach_is_not_scored(pipeline, photo, monkeypatch):
    """Undistortion leaves black corners, which the mask leaves out."""
    model, (camera, batch) = pipeline.model, photo
    monkeypatch.setattr(HalfImageProtocol, "fit", lambda *_: model.appearance.vectors[0].detach())
    cut = batch["image"].shape[0] // 3
    cornered = {"image": batch["image"].clone(), "mask": torch.ones_like(batch["image"][..., :1]).bool()}
    cornered["image"][:cut], cornered["mask"][:cut] = 0, False
    rows = model.get_gt_img(batch["image"])[cut:]
    outputs = model.get_outputs(camera)
    expected = float(psnr(outputs["rgb"][cut:], rows))
    assert expected > float(psnr(outputs["rgb"], model.get_gt_img(cornered["image"]))) + 1
    metrics, _ = model.get_image_metrics_and_images(outputs, cornered)
    assert metrics["psnr"] == pytest.approx(expected, abs=1e-3)
    rest, target, mask = (outputs["rgb"][cut:], rows), cornered["image"] / 255, cornered["mask"][..., 0]
    assert corrected_psnr(outputs["rgb"], target, mask) == pytest.approx(corrected_psnr(*rest), abs=1e-2)
    rendering, figures = half_image(model, camera, cornered)
    right = [halves(picture)[1] for picture in (rendering[cut:], rows)]
    assert figures["half_psnr"] == pytest.approx(float(psnr(*right)), abs=1e-3)


def test_a_black_photo_without_any_pixel_counts_whole(pipeline):
    black, gray = torch.zeros(30, 40, 3), torch.full((30, 40, 3), 0.1)
    metrics = pipeline.model.image_metrics(gray, black, torch.zeros(30, 40, dtype=torch.bool))
    assert metrics["psnr"] == pytest.approx(20.0, abs=1e-3)


def test_the_fit_lowers_the_left_halfs_error(pipeline, photo):
    model, (camera, batch) = pipeline.model, photo
    left, _ = halves(batch["image"] / 255)
    looks = [fit_look(model, camera, left, steps=steps) for steps in (0, 6, 30)]
    errors = [float(rgb_loss(halves(shown(model, camera, look))[0], left)) for look in looks]
    assert errors[0] > errors[1] > errors[2]


def test_the_fit_begins_as_an_unseen_view(pipeline, photo):
    model, (camera, batch) = pipeline.model, photo
    vector = fit_look(model, camera, halves(batch["image"] / 255)[0], steps=0)
    assert torch.equal(shown(model, camera, vector), shown(model, camera))


def test_a_known_look_is_found_again(pipeline, photo):
    """A picture of the scene itself, in the look of a photo far away."""
    model, (camera, _) = pipeline.model, photo
    pictures = [shown(model, camera, vector) for vector in model.appearance.vectors.detach()]
    start = shown(model, camera)
    picture = max(pictures, key=lambda p: float((p - start).abs().mean()))
    _, found = half_image(model, camera, {"image": (255 * picture).round().to(torch.uint8)})
    plain = model.image_metrics(halves(start)[1], halves(picture)[1])["psnr"]
    assert found["half_psnr"] > plain + 6


def test_an_evaluation_leaves_the_model_as_it_was(pipeline):
    model = pipeline.model
    before = {name: value.clone() for name, value in model.state_dict().items() if torch.is_tensor(value)}
    for parameter in model.parameters():
        parameter.grad = None
    pipeline.get_average_eval_image_metrics(get_std=True)
    after = model.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    assert all(parameter.grad is None for parameter in model.parameters())
    pipeline.eval()


def test_it_is_the_headline_where_photos_have_looks(pipeline):
    results = pipeline.get_average_eval_image_metrics(get_std=True)
    assert next(iter(results)) == "half_psnr"
    assert {"half_ssim", "half_psnr_std", "fit_seconds", "psnr", "cc_psnr"} <= set(results)
    assert "left half" in results["protocol"]["colors"]
    pipeline.eval()


def test_scenes_in_one_light_keep_their_figures(train, scene):
    pipeline = train(scene, iterations=2, semantics=False, **{USE: "off"}).pipeline
    results = pipeline.get_average_eval_image_metrics(get_std=True)
    assert not [name for name in results if name.startswith(("half_", "fit_"))]
    assert "colors" not in results["protocol"]
