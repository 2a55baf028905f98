"""The GPU path: all components keep to one device, and the host rarely waits.

On a fake GPU (fake_gpu.py), and with `-m cuda` on the machine's own, where waits are not counted.

Runs are a few steps on a tiny scene; they are made once and shared.
"""

from dataclasses import replace
from functools import cache
from importlib import import_module

import pytest
import torch
from fake_gpu import CUDA, GpuTensor, fake_gpu, real_gpu
from runs import make_trainer
from scenes import write_scene

from lab.baselines import BASELINES, langsplat
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.open_scene import load_scene
from lang3dxl_ns.query.ask import prompts_of
from lang3dxl_ns.scene.capture import open_capture
from lang3dxl_ns.training import fit, gaussians
from lang3dxl_ns.training.step import decoded_side, losses

pytestmark = pytest.mark.nerfstudio

EVERYTHING = {
    "pipeline__model__decoder__name": "paper",
    "pipeline__model__densify_grad_thresh": 1e-7,
    "pipeline__model__feature_gradient_to_geometry": True,
    "pipeline__model__background_color": "random",
    "pipeline__model__view_dependence": "on",
    "pipeline__datamanager__regions": "felzenszwalb",
}
LOOKS = {"pipeline__model__appearance__use": "on", "pipeline__model__camera_optimization": "on"}
REAL = [pytest.param(real_gpu, marks=pytest.mark.cuda, id="real")] if torch.cuda.is_available() else []


@pytest.fixture(scope="module", params=[pytest.param(fake_gpu, id="fake"), *REAL])
def gpu(request):
    """Makes a GPU, fake or real, for a block of code."""
    return request.param


@pytest.fixture
def fake(gpu):
    """For tests of what only the fake GPU tells."""
    if gpu is not fake_gpu:
        pytest.skip("only the fake GPU counts waits, and can be another one")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("gpu") / "scene", photos=5, points=60, size=(40, 30))


@pytest.fixture(scope="module")
def trained(gpu, small, tiny_clip, tiny_dense, tmp_path_factory):
    """Trains on the GPU and returns the trainer, with `waits`: the counted waits of every step."""
    import_module("lang3dxl_ns.methods")  # its defaults look for a GPU once: before there is a fake one

    def run(iterations=4, semantics=True, fake=None, **changes):
        changes = {"machine__device_type": "cuda", "steps_per_eval_image": 0, **changes}
        changes.setdefault("pipeline__model__sky_gaussians", 40)
        folder = tmp_path_factory.mktemp("runs")
        with gpu(**fake or {}) as present:
            trainer = make_trainer(small, tiny_clip, tiny_dense, folder, iterations, semantics, **changes)
            torch.backends.cudnn.benchmark = True  # as ns-train does
            trainer.setup()
            trainer.waits = []
            count_steps(trainer, present)
            trainer.train()
        assert all(parameter.device == CUDA for parameter in trainer.pipeline.model.parameters())
        return trainer

    return run


def count_steps(trainer, gpu) -> None:
    """Each step and the callbacks after it (densification's statistics) in one count."""
    step, callbacks = trainer.train_iteration, trainer.callbacks

    def counted(number):
        with gpu.counting() as before:
            result = step(number)
        with gpu.counting() as after:
            for callback in callbacks:
                callback.run_callback_at_location(number, AFTER)
        trainer.waits.append(before + after)
        return result

    from nerfstudio.engine.callbacks import TrainingCallbackLocation

    AFTER = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
    trainer.train_iteration = counted
    trainer.callbacks = [c for c in callbacks if AFTER not in c.where_to_run]
    assert len(trainer.callbacks) < len(callbacks)


@pytest.fixture(scope="module")
def default(trained):
    """A finished run of the default settings."""
    return trained(iterations=6, pipeline__model__densify_until=0.0)


@pytest.fixture(scope="module")
def densified(trained):
    return cache(lambda **changes: trained(iterations=6, **EVERYTHING | changes))


def own(waits) -> int:
    """Waits that are the package's; gsplat has one of its own in every pass."""
    return waits.total() - waits["gsplat"]


# ── training ────────────────────────────────────────────────────────────────────────────────────────────


def test_a_default_step_waits_once_beside_gsplat(default, fake):
    """For the guard, which decides whether the optimizers may step."""
    assert default.waits[1:] == [{"aten._local_scalar_dense": 1, "gsplat": 1}] * 5


def test_a_step_of_everything_waits_twice_beside_gsplat(trained, fake):
    """Also for the Gaussians in view, of which the look is computed."""
    shift = {"pipeline__model__appearance__opacity_shift": True, "pipeline__model__densify_until": 0.0}
    trainer = trained(**EVERYTHING | LOOKS | shift, mixed_precision=True)
    assert {(own(waits), waits["gsplat"]) for waits in trainer.waits[1:]} == {(2, 2)}
    assert torch.isfinite(torch.stack([loss.cpu() for loss in trainer.pipeline.last_losses.values()])).all()


def test_densification_grows_and_stays_on_the_gpu(densified):
    model = densified().pipeline.model
    assert model.num_points > 100
    assert {len(p) for p in model.gauss_params.values()} == {model.num_points}


def test_gradients_of_densification_do_not_depend_on_the_loss_scale(densified):
    """GradScaler multiplies the loss by 65,536, and the strategy's threshold must not notice."""
    threshold = {"pipeline__model__densify_grad_thresh": 3e-3}
    counts = [
        densified(use_grad_scaler=scaled, **threshold).pipeline.model.num_points for scaled in (False, True)
    ]
    assert counts[0] == counts[1]
    assert counts[0] != densified().pipeline.model.num_points


@pytest.mark.parametrize("capability", [(8, 6), (7, 5)])
def test_mixed_precision_is_bfloat16_without_a_scale_where_the_gpu_has_it(trained, fake, capability):
    trainer = trained(2, mixed_precision=True, semantics=False, fake={"capability": capability})
    assert trainer.grad_scaler.is_enabled() is (capability < (8, 0))
    wanted = torch.float16 if capability < (8, 0) else torch.bfloat16
    assert torch.get_autocast_dtype("cuda") == wanted


@pytest.mark.parametrize("mixed", [False, True])
def test_a_step_without_nerfstudio_is_in_mixed_precision_if_that_is_wanted(
    gpu, small, tiny_clip, tiny_dense, tmp_path, monkeypatch, mixed
):
    seen = []

    def noted(*arguments):
        seen.append(torch.is_autocast_enabled("cuda") and torch.get_autocast_dtype("cuda"))
        return losses(*arguments)

    monkeypatch.setattr(fit, "losses", noted)
    settings = fit.Settings.of("lang3dxl", 2)
    settings.targets.clip, settings.targets.dense = str(tiny_clip), str(tiny_dense)
    settings.scene.sky_gaussians, settings.mixed_precision = 40, mixed
    with gpu():
        run = fit.begin(open_capture(small), settings, tmp_path / "run", tmp_path / "cache", "cuda")
        run.iterate(0)
    assert seen == [torch.bfloat16 if mixed else False]


def test_cudnn_does_not_tune_for_every_size(default):
    assert torch.backends.cudnn.benchmark is False


def test_code_maps_are_decoded_at_five_sizes(default):
    model = default.pipeline.model
    sizes = set()
    for model.run.step in range(200):
        sizes.add(decoded_side(model.run))
    assert len(sizes) == 5
    assert (min(sizes), max(sizes)) == model.config.decode_size


@pytest.mark.nightly
@pytest.mark.parametrize("name", BASELINES)
def test_every_decoder_trains(trained, name, monkeypatch):
    monkeypatch.setattr(langsplat, "_STEPS", 5)
    trained(2, pipeline__model__decoder__name=name, pipeline__model__densify_until=0.0)


@pytest.mark.parametrize("preset", ["official", pytest.param("paper", marks=pytest.mark.nightly)])
def test_every_preset_of_the_field_trains(trained, preset):
    field = {"preset": preset, "log2_table_size": 12}  # half a million entries a level take seconds to save
    changes = {f"pipeline__model__semantic_field__{name}": value for name, value in field.items()}
    trained(1, pipeline__model__decoder__name="paper", **changes)


def test_a_cap_holds_and_the_least_opaque_go(trained):
    trainer = trained(
        6, semantics=False, pipeline__model__densify_grad_thresh=1e-7, pipeline__model__max_gaussians=110
    )
    model = trainer.pipeline.model
    assert model.num_points == 110
    assert len(model.run.statistics["grad2d"]) == 110


def test_out_of_memory_ends_in_three_settings_that_help(trained, monkeypatch):
    """The checkpoint of before stays the latest."""
    from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer

    step, saved = Lang3DXLTrainer.train_iteration, []

    def full(self, number):
        if number == 3:
            saved.extend(self.checkpoint_dir.glob("*.ckpt"))
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        return step(self, number)

    monkeypatch.setattr(Lang3DXLTrainer, "train_iteration", full)
    with pytest.raises(UserError) as error:
        trained(4, semantics=False, steps_per_save=2)
    told = str(error.value)
    for setting in ("max-gaussians", "camera-res-scale-factor", "view-dependence", "--load-dir"):
        assert setting in told
    assert saved == list(saved[0].parent.glob("*.ckpt"))


def test_a_resumed_run_goes_on(trained):
    first = trained(4, semantics=False, mixed_precision=True)
    again = trained(6, semantics=False, mixed_precision=True, load_dir=first.checkpoint_dir)
    assert again._start_step == 4
    before, after = (t.pipeline.model.gauss_params["features_dc"].detach().cpu() for t in (first, again))
    assert not torch.equal(before, after[: len(before)])


def test_the_torch_rasterizer_renders_on_the_gpu_without_gsplat(trained, monkeypatch):
    monkeypatch.setattr("fake_gpu.gsplat_stand_in", lambda *_, **__: pytest.fail("gsplat was called"))
    trained(2, semantics=False, pipeline__model__rasterizer="torch")


# ── after training ──────────────────────────────────────────────────────────────────────────────────────


def test_evaluation(default, gpu):
    with gpu():
        metrics = default.pipeline.get_average_eval_image_metrics()
    assert metrics["psnr"] > 0 and metrics["clip_l1"] > 0


def test_no_photo_of_a_query_is_waited_for(default, fake):
    """Rendering and maps wait for nothing (but gsplat); `find` waits as often for one photo as for all."""
    with fake_gpu() as gpu:
        scene = load_scene(default.base_dir / "config.yml")
        assert scene.device == CUDA
        question = scene.ask("tower; window")
        camera, channels = scene.camera(scene.file.photos[0].name), question.channels
        with gpu.counting() as waits:
            maps, masks = question.maps(scene.draw(camera, channels))
        assert waits == {"gsplat": 1}
        assert maps.device == masks.device == CUDA
        counts = []
        for views in (scene.visible, dict(list(scene.visible.items())[:1])):
            scene.__dict__["visible"] = views
            scene.find("tower")  # what is computed once
            with gpu.counting() as waits:
                scene.find("tower")
            counts.append(waits)
        assert counts[0] == counts[1]
        assert question.relevancy.device == CUDA


def test_words_on_the_gpu_are_those_on_the_cpu(default, gpu):
    """Gathered features, and relevancies of a finished run."""
    from lang3dxl_ns.rendering import Gaussians, rasterize
    from lang3dxl_ns.rendering.gathering import Pixels, gather
    from lang3dxl_ns.scene.camera import Camera

    draw = torch.Generator().manual_seed(0)
    means = torch.rand(60, 3, generator=draw) - torch.tensor([0.5, 0.5, -2.0])
    parts = means, torch.randn(60, 4, generator=draw), torch.full((60, 3), 0.1), torch.full((60,), 0.6)
    values = torch.rand(24, 32, 5, generator=draw)
    lens = torch.tensor([[30.0, 0.0, 16.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]])

    def gathered(device):
        cloud, camera = Gaussians(*(part.to(device) for part in parts)), Camera(torch.eye(4), lens, 32, 24)
        view = lambda probe: rasterize(cloud, camera, probe).image  # noqa: E731
        features, mass = gather(60, [(view, Pixels.of([values.to(device)], (24, 32)))], 5, cloud.means)
        return features.cpu(), mass.cpu()

    expected = gathered("cpu")
    with gpu():
        found = gathered("cuda")
        scene = load_scene(default.base_dir / "config.yml")
        queries = scene.queries(prompts_of(scene, "tower; window"))
        relevancy, temperature = scene.engine.of_gaussians(queries).cpu(), scene.engine.temperature
        codes = default.pipeline.model.gauss_params["codes"].detach().cpu()
        field = default.pipeline.model.semantic_field
        state = {name: value.cpu() for name, value in field.state_dict().items()}
        vectors = queries.vectors.cpu()
    torch.testing.assert_close(found[1], expected[1], rtol=1e-3, atol=1e-3)
    seen = expected[1] > 0.1
    torch.testing.assert_close(found[0][seen], expected[0][seen], rtol=1e-2, atol=1e-3)
    here = CompressedField(field.config, field.clip_dim)
    here.fit_codes(codes)
    here.load_state_dict(state)
    from lang3dxl_ns.query.engine import make_engine
    from lang3dxl_ns.query.relevancy import Queries

    asked = Queries(vectors, queries.positive, queries.negative)
    there = make_engine(here, codes, temperature).of_gaussians(asked)
    torch.testing.assert_close(relevancy, there, rtol=0, atol=5e-3)


@pytest.mark.cuda
@pytest.mark.skipif(not REAL, reason="needs a GPU")
def test_a_million_gaussians_are_trained_gathered_and_asked(tmp_path):
    from lab.benchmarks import gpu as benchmark

    assert benchmark.step(1_000_000, (1000, 700))["memory (GB)"] < 8
    learned = benchmark.words(1_000_000, (1000, 700), 200)
    assert learned["memory (GB)"] < 8 and learned["centered cosine"] > 0.9


def test_export(default, tmp_path, gpu):
    with gpu():
        scene = load_scene(default.base_dir / "config.yml")
        assert scene.export(tmp_path / "tower.ply", "tower", everything=True) == len(scene.splats)


def test_a_scene_file_answers_words_that_it_does_not_hold(default, gpu):
    with gpu():
        scene = load_scene(default.base_dir)
        assert next(iter(scene.vectors.values())).device == CUDA
        scene.ask(["windows", "crooked weather vane"], foreground="building", negatives=["rusty hook"])


def test_a_conversation_in_the_viewer(default, gpu):
    from contextlib import nullcontext

    from scenes import view_of

    from lang3dxl_ns.training.conversation import Conversation
    from lang3dxl_ns.training.snapshot import Snapshots, snapshot

    pipeline = default.pipeline
    model = pipeline.model.eval()
    with gpu():
        nothing = {"learning": lambda: False, "learn": lambda: None, "watch": lambda _: None}
        snapshots = Snapshots(model.run, pipeline.scene_file, default.base_dir, nullcontext(), **nothing)
        session = Conversation(snapshots, lambda: {"rgb"})
        session.ask("tower")
        model.answers = session
        camera = pipeline.scene_file.photos[0].camera
        outputs = model.get_outputs_for_camera(view_of(camera))
        assert all(value.device == CUDA for value in outputs.values())
        assert snapshot(model.run, pipeline.scene_file).baked().means.device == CUDA
        model.answers = None


@pytest.mark.parametrize(("name", "width", "memory"), [("gathered", 3, 2.0), ("lifting", 65, 5e5)])
def test_words_are_learned_where_memory_is_short(trained, monkeypatch, name, width, memory):
    """Wide features as principal components, a few channels at a time, sums on the CPU."""
    monkeypatch.setattr(CompressedField, "gathered_channels", 5)
    monkeypatch.setattr("lang3dxl_ns.training.learn_codes.DENSE_AXES", 3)
    monkeypatch.setattr("lang3dxl_ns.rendering.gathering.MEMORY", memory)
    model = trained(iterations=3, pipeline__model__decoder__name=name).pipeline.model
    codes = model.gauss_params["codes"]
    assert codes.device == CUDA and codes.shape == (model.num_points, width)
    assert codes.isfinite().all(1).cpu().any()


def test_numerics(gpu):
    from lab.numerics import losses
    from lab.numerics.command import measure_all

    with gpu():
        rows = measure_all(list(losses.cases(quick=True, device="cuda"))[:4], quick=True, device="cuda")
    assert [row.misses for row in rows if row.misses] == []


# ── the fake finds bugs ─────────────────────────────────────────────────────────────────────────────────


def changed(model, change):
    """Lets every rendering, in training or not, have other opacities."""
    activated = gaussians.activated

    def planted(g):
        shapes = activated(g)
        return replace(shapes, opacities=change(shapes))

    gaussians.activated = planted


def bug_tensor_on_the_cpu(model):
    changed(model, lambda shapes: shapes.opacities * torch.ones(3)[:1])


def bug_index_of_a_cpu_tensor(model):
    table = torch.zeros(model.num_points)
    changed(model, lambda shapes: table[(shapes.means[:, 0] > 0).nonzero()[:, 0]])


def bug_numpy(model):
    changed(model, lambda shapes: torch.as_tensor(shapes.opacities.detach().numpy()))


def bug_cpu_generator(model):
    generator = torch.Generator()
    noise = lambda: torch.rand(model.num_points, generator=generator, device=model.device)  # noqa: E731
    changed(model, lambda shapes: shapes.opacities + noise())


@pytest.mark.parametrize(
    ("plant", "error"),
    [
        (bug_tensor_on_the_cpu, "same device"),
        (bug_index_of_a_cpu_tensor, "same device"),
        (bug_numpy, "convert cuda:0 device type tensor to numpy"),
        (bug_cpu_generator, "generator"),
    ],
)
def test_planted_bugs_are_found(default, fake, monkeypatch, plant, error):
    model = default.pipeline.model.eval()
    monkeypatch.setattr(gaussians, "activated", gaussians.activated)  # so that it is restored
    plant(model)
    with fake_gpu(), pytest.raises((RuntimeError, TypeError), match=error):
        model.get_outputs_for_camera(default.pipeline.datamanager.train_dataset.cameras[0:1])


def test_a_planted_wait_is_counted(default, monkeypatch, fake):
    model, activated = default.pipeline.model.eval(), gaussians.activated
    camera = default.pipeline.datamanager.train_dataset.cameras[0:1]

    def impatient(g):
        assert float(g["means"].sum()) < 1e9
        return activated(g)

    found = []
    for planted in (activated, impatient):
        monkeypatch.setattr(gaussians, "activated", planted)
        with fake_gpu() as gpu, gpu.counting() as waits:
            model.get_outputs_for_camera(camera)
        found.append(own(waits))
    assert found[1] == found[0] + 1


@pytest.mark.parametrize(
    ("operation", "reason"),
    [
        (lambda x: float(x.sum()), "aten._local_scalar_dense"),
        (lambda x: x[x > 1], "aten.index by a mask or the CPU's indices"),
        (lambda x: x[[0, 1]], "aten.index by a mask or the CPU's indices"),
        (lambda x: x.nonzero(), "aten.nonzero"),
        (lambda x: x.cpu(), "copy to cpu"),
        (lambda x: torch.ones(3).to(x), "copy to cuda"),
        (lambda x: torch.tensor([1.0], device="cuda"), "copy to cuda"),
        (lambda x: x.tolist(), "tolist"),
        (lambda x: (x + 1).sum(), None),
        (lambda x: torch.ones(3).to("cuda", non_blocking=True), None),
        (lambda x: x[1:] * torch.tensor(2.0), None),
    ],
)
def test_every_wait_is_counted(operation, reason):
    with fake_gpu() as gpu:
        x = torch.arange(3.0).to("cuda", non_blocking=True)
        assert isinstance(x, GpuTensor)
        with gpu.counting() as waits:
            operation(x)
    assert waits == ({} if reason is None else {reason: 1})
