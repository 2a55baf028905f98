"""Levels of detail of large scenes: merged Gaussians, and pages that end with the picture of the whole."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from pages import DESK, STAND, opened, picture, served
from painted_scene import painted_codes, painted_looks, painted_scene, painted_splats

from lang3dxl_ns.rendering import Splats, render
from lang3dxl_ns.rendering.projection import rotations
from lang3dxl_ns.web.levels import levels_of, merged, tree_order
from lang3dxl_ns.web.write_page import Page, write_page

MOST = 500
"""Most Gaussians of a chunk here; the rough wall has ten times as many."""
HELD = """async () => {
  while (lang3dxl.view.parts.size < 21) await new Promise((go) => setTimeout(go, 50));
}"""


def some_splats(count: int, seed: int = 0) -> Splats:
    g = torch.Generator().manual_seed(seed)
    means, quats = torch.randn(count, 3, generator=g), torch.randn(count, 4, generator=g)
    scales, opacities = torch.rand(count, 3, generator=g) * 0.3 + 0.01, torch.rand(count, generator=g) * 0.2
    return Splats(means, quats, scales, opacities, torch.randn(count, 4, 3, generator=g))


def rough_wall():
    """The painted wall in more detail, with no two Gaussians at one depth."""
    splats = painted_splats(12)
    depths = 0.02 * torch.rand(len(splats), 1, generator=torch.Generator().manual_seed(0))
    return painted_scene(
        splats=replace(splats, means=splats.means + F.pad(depths, (2, 0))), codes=painted_codes(12)
    )


def even_splats(means):
    """Round Gaussians of one size."""
    count = len(means)
    quats, scales = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), torch.full((count, 3), 0.01)
    return Splats(means, quats, scales, torch.full((count,), 0.5), torch.zeros(count, 1, 3))


def test_an_order_keeps_neighbors_together_at_every_level():
    points = torch.rand(4096 + 320, 3, generator=torch.Generator().manual_seed(0))
    order = tree_order(even_splats(points), torch.zeros(len(points), 0))
    assert torch.equal(order.sort().values, torch.arange(len(points)))
    for size in (4, 16, 64):
        groups = points[order][: len(points) // size * size].reshape(-1, size, 3)
        side = (groups.amax(1) - groups.amin(1)).amax(1).median()
        assert side < 2.5 * (size / len(points)) ** (1 / 3)  # random groups extend over nearly 1


def test_what_means_two_things_is_merged_apart_where_both_stand_mixed():
    g = torch.Generator().manual_seed(0)
    points, kind = torch.rand(1024, 3, generator=g), torch.arange(1024) % 2
    mixed, apart = (
        (kind[tree_order(even_splats(points), meaning)].reshape(-1, 4).float().std(1) > 0).float().mean()
        for meaning in (torch.zeros(1024, 0), 2.0 * kind[:, None])
    )
    assert mixed > 0.7 and apart < 0.2


def test_merged_gaussians_keep_the_moments_of_what_they_stand_for():
    splats, floats = some_splats(8), torch.rand(8)
    whole, _, floating = merged(splats, None, floats)
    for k in (0, 1):
        rows, mean, total = range(4 * k, 4 * k + 4), np.zeros(3), 0.0
        sizes = splats.scales.double().numpy()
        weight = [
            float(splats.opacities[i]) * (s[0] * s[1] + s[1] * s[2] + s[0] * s[2])
            for i, s in enumerate(sizes)
        ]
        total = sum(weight[i] for i in rows)
        mean = sum(weight[i] * splats.means[i].numpy() for i in rows) / total
        turns = rotations(splats.quats).double().numpy()
        spread = (
            sum(
                weight[i]
                * (
                    turns[i] @ np.diag(sizes[i] ** 2) @ turns[i].T
                    + np.outer(*[splats.means[i].numpy() - mean] * 2)
                )
                for i in rows
            )
            / total
        )
        turn = rotations(whole.quats)[k].double().numpy()
        np.testing.assert_allclose(whole.means[k], mean, atol=1e-5)
        np.testing.assert_allclose(turn @ np.diag(whole.scales[k].double() ** 2) @ turn.T, spread, atol=1e-5)
        colors = sum(weight[i] * splats.harmonics[i].numpy() for i in rows) / total
        np.testing.assert_allclose(whole.harmonics[k], colors, atol=1e-5)
        np.testing.assert_allclose(floating[k], sum(weight[i] * floats[i] for i in rows) / total, atol=1e-5)
        assert 0 < whole.opacities[k] <= 1


def test_copies_at_one_place_merge_to_themselves_and_the_invisible_weighs_nothing():
    one = some_splats(1)
    splats = one.mapped(lambda values: values.repeat(4, *[1] * (values.dim() - 1)))
    shown = torch.tensor([1.0, 0.0, 0.0, 0.0])
    codes = torch.tensor([[0.3], [9.0], [torch.nan], [9.0]])
    moved = Splats(
        splats.means + torch.arange(4.0)[:, None],
        splats.quats,
        splats.scales,
        splats.opacities * shown,
        splats.harmonics,
    )
    whole, code, _ = merged(moved, codes, torch.zeros(4))
    torch.testing.assert_close(whole.means, one.means)
    torch.testing.assert_close(whole.scales.sort(1).values, one.scales.sort(1).values)
    torch.testing.assert_close(whole.opacities, one.opacities)
    assert code.tolist() == [[codes[0, 0].item()]]


@pytest.mark.parametrize(("part", "value"), [("means", -1e30), ("means", 1e20), ("scales", 1e26)])
def test_one_gaussian_far_out_or_huge_leaves_the_others_as_they_are(part, value):
    splats = painted_splats()
    getattr(splats, part)[5] = value
    opacities = splats.opacities.clone()
    opacities[5] = 0
    scenes = [painted_scene(splats=one) for one in (splats, replace(painted_splats(), opacities=opacities))]
    coarse, expected = (levels_of(scene, MOST).scenes[0].splats for scene in scenes)
    assert coarse.sound().all()
    assert float(coarse.means.abs().max()) <= float(painted_splats().means.abs().max())
    assert float(coarse.opacities.sum()) == pytest.approx(float(expected.opacities.sum()), rel=0.02)


def test_the_finest_level_is_the_scene_and_coarser_ones_answer():
    scene = rough_wall()
    levels = levels_of(scene, MOST)
    finest, camera = levels.scenes[-1], scene.photos[0].camera
    assert levels.chunks == 1 + 4 + 16 and levels.rows % 64 == 0 and levels.rows <= MOST + 64
    torch.testing.assert_close(
        render(finest.splats, camera).rgb, render(scene.splats, camera).rgb, atol=1e-4, rtol=0
    )
    for level in levels.scenes:
        assert len(level.splats) == levels.rows * 4 ** levels.scenes.index(level)
        for name, view in scene.visible.items():
            assert abs(level.visible[name].pixels.sum() / view.pixels.sum() - 1) < 1e-2
    fine, coarse = (level.relevancy("dome") for level in levels.scenes[1:][::-1])
    inside = (fine.reshape(-1, 4) > 0.5).all(1)
    assert inside.sum() > 20 and (coarse[inside] > 0.5).all()
    assert (coarse[(fine.reshape(-1, 4) < 0.1).all(1)] < 0.1).all()


def test_a_page_of_chunks_ends_with_the_picture_and_the_heat_of_the_whole(browser, tmp_path):
    scene = rough_wall()
    pictures, words = [], []
    for name, large in (("whole", 10_000), ("chunks", MOST)):
        page = Page(scene, large=large)
        write_page(page, tmp_path / name)
        with served(tmp_path / name) as address:
            tab = opened(browser, address, DESK)
            tab.evaluate("lang3dxl.ready.then(() => lang3dxl.ask('dome')).then(() => true)")
            if page.levels:
                tab.evaluate(HELD)
                tab.wait_for_timeout(500)
            tab.evaluate(STAND)
            pictures.append(picture(tab))
            words.append(dict(tab.evaluate("lang3dxl.whatIs(192, 192)")))
            assert tab.complaints == []
            tab.close()
    assert np.abs(pictures[0] - pictures[1]).mean() < 1.5 and pictures[0].std() > 15
    assert words[0].keys() == words[1].keys() and words[0]
    assert all(abs(words[0][word] - words[1][word]) < 0.02 for word in words[0])


ARRIVING = """async () => {
  const { view } = lang3dxl;
  view.wake();
  for (let k = 0; k < 400; k++) {
    view.repaint(0); // as arriving detail does
    await new Promise((go) => setTimeout(go, 30));
    if (view.sharp) return true;
  }
  return false;
}"""


def test_the_picture_is_sharp_while_detail_arrives_and_numbers_are_of_the_whole(browser, tmp_path):
    scene = rough_wall()
    write_page(Page(scene, large=MOST), tmp_path)
    with served(tmp_path) as address:
        tab = opened(browser, address, DESK)
        found = tab.evaluate("lang3dxl.ready.then(() => lang3dxl.ask('dome'))")
        tab.evaluate(HELD)
        assert tab.evaluate(ARRIVING)
        tab.close()
    exact = int(scene.ask("dome").gaussians[0].sum())
    assert abs(found["matching"] / exact - 1) < 0.2


def test_a_lighting_reaches_the_details(browser, tmp_path):
    page = Page(painted_scene(looks=painted_looks()), large=MOST)
    write_page(page, tmp_path)
    with served(tmp_path) as address:
        tab = opened(browser, address, DESK)
        tab.evaluate(HELD)
        before, after = (
            tab.evaluate(f"""async () => {{
              const wait = () => new Promise((go) => setTimeout(go, 300)), {{ view }} = lang3dxl;
              const light = view.light.bind(view);
              let lit = false;
              view.light = (...given) => (light(...given), (lit = true));
              document.getElementById("look").value = "{look}";
              document.getElementById("look").dispatchEvent(new Event("change"));
              do await wait(); while ("{look}" && !lit);
              view.light = light;
              const mean = ({{ plain }}) => plain.reduce((a, b) => a + b, 0) / plain.length;
              return [...lang3dxl.view.parts.values()].map(mean);
            }}""")
            for look in ("", page.scene.looks.names[0])
        )
        tab.close()
    changes = np.array(after) - np.array(before)
    assert len(changes) == 21 and abs(changes[0]) > 0.5
    assert np.sign(changes[changes != 0]).tolist().count(np.sign(changes[0])) > 15


def test_what_a_large_page_loads_first_is_independent_of_its_size():
    files = Page(painted_scene(), large=MOST).files()
    about = json.loads(files["scene.json"])
    chunks = about["detail"]["chunks"]
    assert len(chunks) == 21 and {f"part{k}.bin" for k in range(1, 21)} <= files.keys()
    assert len(files["splats.bin"]) == 16 * about["detail"]["rows"] == 16 * about["count"]
    assert all(len(files[f"part{k}.bin"]) == (17 + 2 * 16) * about["count"] for k in range(1, 21))
