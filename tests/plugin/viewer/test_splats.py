"""Gaussians that the browser draws: their shapes, colors and heat, and the panel on a page of its own."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import viser.transforms as tf
from conftest import make_trainer
from nerfstudio.configs.base_config import ViewerConfig
from scenes import write_scene

from lang3dxl_ns.plugin.cameras import view_of
from lang3dxl_ns.plugin.light import in_light
from lang3dxl_ns.plugin.open_run import open_run
from lang3dxl_ns.plugin.viewer import browser
from lang3dxl_ns.plugin.viewer.browser import BrowserViewer, camera_of
from lang3dxl_ns.plugin.viewer.splats import splats, with_heat
from lang3dxl_ns.query.answer import Display
from lang3dxl_ns.query.heat_maps import overlay
from lang3dxl_ns.rendering import Gaussians, rasterize


def some_gaussians(n: int = 50, seed: int = 0) -> Gaussians:
    rng = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.randn(n, 3, generator=rng),
        torch.randn(n, 4, generator=rng),
        torch.rand(n, 3, generator=rng) + 0.01,
        torch.rand(n, generator=rng) * 0.9 + 0.1,
    )


def test_covariances_are_those_of_the_ellipsoids_in_the_viewers_units():
    g = some_gaussians()
    found = splats(g, torch.rand(50, 3), scale=10.0)
    np.testing.assert_allclose(found.centers, 10 * g.means.numpy(), rtol=1e-6)
    for i in range(50):
        # The reference: axes turned by viser's own rotations, each as long as its deviation.
        axes = tf.SO3(g.quats[i].double().numpy() / np.linalg.norm(g.quats[i].double())).as_matrix()
        axes = axes * (10 * g.scales[i].double().numpy())
        np.testing.assert_allclose(found.covariances[i], axes @ axes.T, rtol=1e-4, atol=1e-6)


def test_invisible_and_broken_gaussians_are_left_out():
    g = some_gaussians(6)
    g.opacities[1] = 1e-3
    g.means[2, 0] = float("nan")
    g.quats[3] = 0.0  # counts as no rotation
    found = splats(g, torch.rand(6, 3), scale=1.0)
    assert len(found.centers) == 4 and all(np.isfinite(part).all() for part in vars(found).values())
    np.testing.assert_allclose(found.covariances[1], np.diag(g.scales[3].numpy() ** 2), rtol=1e-5)
    assert found.megabytes == pytest.approx(4 * 32 / 1e6)


@pytest.mark.parametrize("highest", [None, 0.9])
def test_heat_is_mixed_into_gaussians_as_into_pixels(highest):
    colors, relevancy = torch.rand(40, 3), torch.rand(40)
    display = Display(opacity=0.6, color_map="viridis")
    mixed = with_heat(colors, relevancy, 0.4, display, highest)
    pixels = overlay(colors.view(5, 8, 3), relevancy.view(5, 8), 0.4, 0.6, "viridis", highest)
    torch.testing.assert_close(mixed, pixels.view(40, 3))
    assert torch.equal(mixed[relevancy <= 0.4], colors[relevancy <= 0.4])


@pytest.fixture(scope="module")
def run(tmp_path_factory, tiny_clip, tiny_dense):
    """The config.yml of a run with appearance, whose photos are gone."""
    root = tmp_path_factory.mktemp("run")
    data = write_scene(root / "scene", photos=6, points=200, mixed=True)
    changes = {"pipeline__model__appearance__use": "on", "steps_per_eval_image": 0}
    trainer = make_trainer(data, tiny_clip, tiny_dense, root / "outputs", 20, **changes)
    trainer.setup()
    trainer.train()
    (data / "images").rename(data / "renamed")
    return trainer.base_dir / "config.yml"


@pytest.fixture(scope="module")
def viewer(run):
    """What `lang3dxl view` serves; `drawn` holds what the page was last sent."""
    patch, drawn = pytest.MonkeyPatch(), SimpleNamespace(names=[])
    send = browser.sent

    def noted(scene, name, what):
        drawn.what = what
        drawn.names.append(name)
        return send(scene, name, what)

    patch.setattr(browser, "sent", noted)
    config, pipeline, _ = open_run(run)
    with torch.no_grad():  # photos whose lights differ plainly
        looks = pipeline.model.appearance
        for part, size in ((looks.output.weight, 0.2), (looks.output.bias, 0.0), (looks.vectors, 2.0)):
            part.uniform_(-size, size, generator=torch.Generator().manual_seed(0))
    viewer = BrowserViewer(pipeline, ViewerConfig(websocket_host="127.0.0.1"), config.get_base_dir())
    viewer.drawn = drawn
    settle(viewer)
    yield viewer
    viewer.viser_server.stop()
    patch.undo()


def settle(viewer):
    panel = viewer._panel
    assert panel._asker.wait() and panel._finder.wait() and viewer._drawer.wait()


def ask(viewer, text):
    panel = viewer._panel
    panel._question.value = text
    panel._asker.submit(panel._guarded(panel._ask))
    settle(viewer)


def test_colors_in_a_light_are_those_of_the_rendering(viewer):
    model, photo = viewer._model, viewer._panel._photos[1]
    look = model.appearance.names[0]
    gaussians, colors = in_light(model, photo.camera, look)
    model.look = look
    with torch.no_grad():
        rendered = model.get_outputs(view_of(photo.camera))["rgb"]
    model.look = None
    ours = rasterize(gaussians, photo.camera, colors, torch.zeros(3)).image.clamp(0, 1)
    # The pose is inverted twice on the way: a contribution at the threshold of 1/255 may come or go.
    difference = (ours - rendered).abs()
    assert difference.max() < 1 / 255 and (difference > 1e-4).float().mean() < 1e-3


def test_a_prompt_a_threshold_and_a_light_send_colors_and_nothing_else(viewer):
    panel, plain = viewer._panel, viewer.drawn.what
    panel._threshold.value = 0.0  # with CLIP's random weights nothing is sure to be found
    panel._take_settings()
    ask(viewer, "dome; door")
    asked = viewer.drawn.what
    assert np.abs(asked.colors - plain.colors).max() > 0.1
    np.testing.assert_array_equal(asked.centers, plain.centers)
    assert panel._tours and "Gaussians" in panel._status.content
    panel._threshold.value = 1.0
    panel._take_settings()
    settle(viewer)
    np.testing.assert_allclose(viewer.drawn.what.colors, plain.colors)
    lights = []
    for look in panel._look.options[1:3]:
        panel._look.value = look
        panel._take_settings()
        settle(viewer)
        lights.append(viewer.drawn.what.colors)
    assert np.abs(lights[0] - lights[1]).max() > 0.1
    panel._look.value = panel._look.options[0]
    panel._take_settings()
    ask(viewer, "")
    np.testing.assert_allclose(viewer.drawn.what.colors, plain.colors)


def test_colors_come_under_a_new_name_and_those_before_are_taken_away(viewer):
    """A page keeps what it shows under a name, even where it was removed a moment ago."""
    settle(viewer)
    names = viewer.drawn.names[-1:]
    for _ in range(3):
        viewer._trigger_rerender()
        settle(viewer)
        names.append(viewer.drawn.names[-1])
    assert len(set(names)) == len(names)
    kept = viewer.viser_server._websock_server._broadcast_buffer.message_from_id.values()
    named = [(type(message).__name__, message.name) for message in kept if hasattr(message, "name")]
    # Whoever comes now gets the last alone; whoever has seen the others hears that they are gone.
    assert [name for kind, name in named if kind == "GaussianSplatsMessage"] == names[-1:]
    assert {name for kind, name in named if kind == "RemoveSceneNodeMessage"} >= set(names[:-1])


def test_a_still_is_the_view_of_the_page(viewer):
    photo = viewer._panel._photos[0]
    view = photo.camera.view_matrix.double().numpy()
    page = SimpleNamespace(
        wxyz=tf.SO3.from_matrix(view[:3, :3].T).wxyz,
        position=10.0 * -view[:3, :3].T @ view[:3, 3],
        fov=2 * np.arctan(photo.lens.height / 2 / photo.lens.fy),
        aspect=1.0,
    )
    camera = camera_of(page, 10.0, height=photo.lens.height)
    torch.testing.assert_close(camera.view_matrix, photo.camera.view_matrix, atol=1e-5, rtol=0)
    assert float(camera.intrinsics[1, 1]) == pytest.approx(photo.lens.fy)
    assert camera.width == camera.height
    assert viewer.still(camera).startswith(b"\x89PNG")
