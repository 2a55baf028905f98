"""The appearance field in the model: its effects, and its checkpoint."""

from copy import deepcopy

import pytest
import torch
from looks import in_look
from nerfstudio.utils.eval_utils import eval_setup
from runs import make_trainer, train_run

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.preparation.targets import SceneFacts

USE = "pipeline__model__appearance__use"
CODES = "pipeline__model__decoder__name"
SHIFT = "pipeline__model__appearance__opacity_shift"


@pytest.fixture
def train(train):
    """Training with appearance on, whatever the scene's needs."""
    return lambda *args, **changes: train(*args, **{USE: "on", CODES: "paper", **changes})


@pytest.fixture(scope="module")
def lit(scene, tiny_clip, tiny_dense, tmp_path_factory):
    """A finished run with appearance and without semantics, to look at."""
    folder = tmp_path_factory.mktemp("lit")
    return train_run(scene, tiny_clip, tiny_dense, folder, 20, semantics=False, **{USE: "on"})


def step_camera(trainer, index=0):
    """Camera and batch of a training photo, from the data manager."""
    datamanager = trainer.pipeline.datamanager
    datamanager.data._upcoming.insert(0, index)
    return datamanager.next_train(0)


def eval_camera(trainer):
    return next(iter(trainer.pipeline.datamanager.fixed_indices_eval_dataloader))[0]


def show(model, camera, look=None) -> dict[str, torch.Tensor]:
    model.eval()
    rendering = in_look(model, camera, None if look is None else model.appearance.of_photo(look))
    return {"rgb": rendering.rgb, "accumulation": rendering.alpha[..., None], "depth": rendering.depth}


def gaussians(trainer) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in trainer.pipeline.model.gauss_params.items()}


def test_off_builds_no_parameters(train, scene):
    trainer = train(scene, iterations=1, semantics=False, **{USE: "off"})
    model = trainer.pipeline.model
    assert model.appearance is None
    assert not [name for name in model.state_dict() if "appearance" in name]
    assert set(trainer.optimizers.optimizers) == {*model.gauss_params, "sky"}


def test_scene_needs_decide_what_is_auto(train, scene, monkeypatch):
    config = deepcopy(train(scene, iterations=1, semantics=False).pipeline.model.config)
    for use, needs, expected in (
        ("auto", {}, True),
        ("auto", {"appearance": False}, False),
        ("auto", {"appearance": True}, True),
        ("on", {"appearance": False}, True),
        ("off", {"appearance": True}, False),
    ):
        config.appearance.use = use
        assert SceneFacts(needs=needs).wants("appearance", config.appearance.use) is expected


def test_first_iteration_moves_gaussians_as_without_appearance(train, scene):
    """An untrained field changes neither rendering nor gradients. (A smooth sky would.)"""
    changes = {"semantics": False, "pipeline__model__sky_gaussians": 0}
    with_it, without = (
        gaussians(train(scene, iterations=1, **changes, **{USE: use})) for use in ("on", "off")
    )
    for name in without:
        assert torch.equal(with_it[name], without[name]), name


def test_a_look_changes_colors_and_nothing_else(train, scene):
    trainer = train(scene, iterations=2, semantics=False, **{SHIFT: True})
    model, camera = trainer.pipeline.model, eval_camera(trainer)
    with torch.no_grad():
        model.appearance.output.bias.uniform_(-2, 2)
        model.appearance.output.weight.uniform_(-2, 2)
    first, second = (show(model, camera, model.appearance.names[i]) for i in (0, 5))
    assert not torch.equal(first["rgb"], second["rgb"])
    for name in first.keys() - {"rgb"}:
        assert torch.equal(first[name], second[name]), name


@pytest.mark.parametrize("opacity_shift", [False, True])
def test_semantic_gradients_do_not_depend_on_the_light(train, scene, opacity_shift):
    trainer = train(scene, iterations=2, **{SHIFT: opacity_shift})
    model = trainer.pipeline.model
    model.train()
    camera, batch = step_camera(trainer)
    gradients = []
    for scale in (1.0, -3.0):
        with torch.no_grad():
            model.appearance.vectors *= scale
            model.appearance.output.bias.fill_(scale)
        model.zero_grad()
        losses = model.get_loss_dict(model.get_outputs(camera), batch)
        (losses["clip"] + losses["dense"]).backward()
        assert all(p.grad is None or not p.grad.any() for p in model.appearance.parameters())
        assert model.means.grad is None or not model.means.grad.any()
        gradients.append(model.gauss_params["codes"].grad.clone())
    assert gradients[0].any() and torch.equal(*gradients)


def test_a_training_view_is_shown_in_its_own_light(lit):
    trainer, model = lit, lit.pipeline.model
    for index in (0, 4):
        camera, batch = step_camera(trainer, index)
        camera.metadata = None
        assert torch.equal(show(model, camera)["rgb"], show(model, camera, batch["name"])["rgb"])


def test_gaussians_out_of_view_need_no_light(lit, monkeypatch):
    trainer = lit
    camera = eval_camera(trainer)
    some = show(trainer.pipeline.model, camera)["rgb"]
    monkeypatch.setattr(
        "lang3dxl_ns.components.appearance.in_view",
        lambda camera, means, scales: torch.ones(len(means), dtype=torch.bool),
    )
    torch.testing.assert_close(some, show(trainer.pipeline.model, camera)["rgb"])


def test_opacity_shift_never_blanks_a_training_step(train, scene, monkeypatch):
    """The released method rendered nothing in half of its steps."""
    brightness = []
    render = Lang3DXLModel.get_outputs

    def watched(self, camera):
        outputs = render(self, camera)
        if self.training:
            brightness.append(float(outputs["rgb"].detach().mean()))
        return outputs

    monkeypatch.setattr(Lang3DXLModel, "get_outputs", watched)
    train(scene, iterations=24, semantics=False, **{SHIFT: True})
    assert len(brightness) == 24
    assert min(brightness) > 0.3 * max(brightness)


def test_resume_with_other_photos_keeps_vectors_by_name(train, scene, tmp_path):
    interval = "pipeline__datamanager__dataparser__eval_interval"
    first = train(scene, iterations=24, semantics=False, **{interval: 3})
    learned = first.pipeline.model.appearance
    changes = {interval: 4, "load_dir": first.checkpoint_dir}
    resumed = make_trainer(scene, None, None, tmp_path, 40, semantics=False, **changes)
    resumed.setup()
    appearance = resumed.pipeline.model.appearance
    new = {photo.name for photo in resumed.pipeline.datamanager.train_dataset.photos} - set(learned.names)
    assert new and set(appearance.names) == new | set(learned.names)
    for name in learned.names:
        assert torch.equal(appearance.vector(name), learned.vector(name))
    before = {name: appearance.vector(name).detach().clone() for name in appearance.names}
    resumed.train()
    for name in {photo.name for photo in resumed.pipeline.datamanager.train_dataset.photos}:
        assert not torch.equal(before[name], appearance.vector(name)), name


def test_checkpoint_loads_safely_and_its_looks_can_be_chosen(lit):
    trainer = lit
    path = next(trainer.checkpoint_dir.glob("*.ckpt"))
    torch.load(path, weights_only=True)
    model, camera = trainer.pipeline.model, eval_camera(trainer)
    _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml", test_mode="inference")
    for look in (None, "photo_004.jpg"):
        assert torch.equal(show(model, camera, look)["rgb"], show(pipeline.model, camera, look)["rgb"])
    with pytest.raises(UserError, match=r"dusk\.jpg"):
        show(pipeline.model, camera, "dusk.jpg")


def test_the_checkpoint_decides_what_is_auto(train, scene):
    without = train(scene, iterations=2, semantics=False, **{USE: "off"})
    again = train(scene, iterations=4, semantics=False, load_dir=without.checkpoint_dir, **{USE: "auto"})
    assert again.pipeline.model.appearance is None
    with pytest.raises(UserError, match="trained without appearance"):
        train(scene, iterations=4, semantics=False, load_dir=without.checkpoint_dir, **{USE: "on"})


def test_held_out_photos_are_measured_with_and_without_color_correction(lit):
    trainer = lit
    metrics = trainer.pipeline.get_average_eval_image_metrics(get_std=True)
    assert metrics["cc_psnr"] > metrics["psnr"]
    assert {"psnr_std", "cc_psnr_std"} <= set(metrics)
