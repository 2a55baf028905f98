"""Training on real photos: the two scenes of the Château de Sceaux, if this machine has them."""

import math
import shutil

import pytest

from lang3dxl_ns.evaluation.score_run import score_features
from lang3dxl_ns.preparation.physical_scale import pixel_sizes, propose_scale_range
from lang3dxl_ns.scene.colmap import read_reconstruction
from lang3dxl_ns.training.snapshot import snapshot


@pytest.fixture(params=[pytest.param("sceaux", marks=pytest.mark.nightly), "sceaux_wild"])
def real_scene(request, real_scenes, tmp_path):
    """A copy, since targets are kept beside the photos."""
    return shutil.copytree(
        real_scenes / request.param, tmp_path / request.param, ignore=shutil.ignore_patterns("lang3dxl_cache")
    )


@pytest.mark.slow
def test_a_short_run_shows_the_facade_and_beats_the_mean_feature(train, real_scene):
    trainer = train(
        real_scene,
        iterations=150,
        pipeline__datamanager__camera_res_scale_factor=0.2,
        pipeline__model__sky_gaussians=2_000,
    )
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    assert all(map(math.isfinite, metrics.values()))
    if real_scene.name == "sceaux":
        assert metrics["psnr"] > 12.0
        assert metrics["clip_l1"] < metrics["clip_l1_of_mean"]
        assert metrics["clip_cosine"] > metrics["clip_cosine_of_mean"]
    else:
        # Exposures differ by 1.5 EV, which a look fitted on half a photo makes up for. The features of a CLIP
        # with random weights follow them: what was learned must serve the photos it was learned from.
        assert metrics["half_psnr"] > 17.0
        datamanager, model = trainer.pipeline.datamanager, trainer.pipeline.model.eval()
        view, batch = next(datamanager.data.every_photo())
        run, side = model.run, model.config.decode_size[1]
        scene = snapshot(run, datamanager.data.record())
        learned = score_features(scene, run.parts.semantics, view.camera(), batch, side)
        assert learned["clip_l1"] < 0.7 * learned["clip_l1_of_mean"]


def test_the_proposed_crops_are_the_same_piece_of_facade_in_both_scenes(real_scenes):
    """The wild scene shows the same walk with other crops and zooms: sizes in the world agree."""
    ranges = []
    for name in ("sceaux", "sceaux_wild"):
        reconstruction = read_reconstruction(real_scenes / name / "sparse" / "0")
        ranges.append(propose_scale_range(reconstruction, pixel_sizes(reconstruction)[0]))
    calm, wild = ranges
    assert 0.5 < wild.smallest / calm.smallest < 2
    assert 0.5 < wild.largest / calm.largest < 2
