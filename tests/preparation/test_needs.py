"""Scene needs: measured on scenes with known answers, and components absent when not needed."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from runs import make_trainer

from lab.landmark.scene_writer import DemoScene, write_scene
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.preparation.needs import needs_table, read_needs, scene_needs, write_needs
from lang3dxl_ns.preparation.physical_scale import plan_crops
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene.photometry import measure_photometry


def collection(folder):
    parser = PhotoCollectionDataParserConfig(data=folder).setup()
    parser.get_dataparser_outputs("train")
    return parser.capture.photos, parser.capture.reconstruction


def verdicts(folder, **settings):
    photos, reconstruction = collection(folder)
    crops = plan_crops(photos, reconstruction, PreparationConfig(**settings))
    needs = scene_needs(photos, reconstruction, crops, dense=True, regions=False)
    return {need.component: need for need in needs}


@pytest.fixture(scope="module")
def landmarks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("landmarks")
    sizes = {"photos": 24, "test_views": 0, "width": 240, "height": 180, "workers": 1}
    return {
        wild: write_scene(DemoScene(out=folder / f"wild-{wild}", seed=4, wild=wild, **sizes))
        for wild in (True, False)
    }


@pytest.mark.slow
def test_the_wild_landmark_needs_light_and_scale_and_the_calm_one_no_light(landmarks):
    wild, calm = verdicts(landmarks[True]), verdicts(landmarks[False])
    assert wild["appearance"].needed and wild["physical scale"].needed
    assert not calm["appearance"].needed and calm["appearance"].value < 0.1
    for needs in (wild, calm):  # painted surfaces have no sheen
        assert not needs["view dependence"].needed
        assert not needs["camera optimizer"].needed
        assert needs["foreground"].needed and needs["foreground"].value > 0.1


@pytest.mark.slow
def test_a_photo_taken_brighter_raises_the_spread_by_its_share(landmarks, tmp_path):
    """n photos, one of them e^d brighter in linear light: the spread grows to d √(n−1) / n."""
    photos, reconstruction = collection(landmarks[False])
    before = measure_photometry(photos, reconstruction)
    changed, stop = [], 0.5
    for i, photo in enumerate(photos):
        pixels = np.asarray(Image.open(photo.path), dtype=float) / 255
        gain = np.exp(-stop / 2.2) if i == 3 else 1.0
        path = tmp_path / f"{i}.png"
        Image.fromarray((255 * pixels * gain).round().astype(np.uint8)).save(path)
        changed.append(replace(photo, path=path))
    after = measure_photometry(changed, reconstruction)
    n = len(photos)
    assert after.spread**2 - before.spread**2 == pytest.approx((stop * (n - 1) ** 0.5 / n) ** 2, rel=0.35)


def test_real_scenes_of_one_light_and_of_many(real_scenes):
    one, many = verdicts(real_scenes / "sceaux"), verdicts(real_scenes / "sceaux_wild")
    for component in ("appearance", "physical scale"):
        assert not one[component].needed, one[component]
        assert many[component].needed, many[component]


def test_photos_of_one_scale_get_one_pyramid_of_fixed_size(scene):
    photos, reconstruction = collection(scene)
    mixed = plan_crops(photos, reconstruction, PreparationConfig())
    assert mixed.pixel_sizes is not None and mixed.spread > 1.6
    alike = plan_crops(photos, seen_from_afar(reconstruction), PreparationConfig())
    assert alike.pixel_sizes is None and alike.spread == pytest.approx(1.0, abs=0.05)
    asked = plan_crops(photos, seen_from_afar(reconstruction), PreparationConfig(scale_mode="physical"))
    assert asked.pixel_sizes is not None


def test_a_number_of_crop_sizes_divides_the_same_range_evenly(scene):
    photos, reconstruction = collection(scene)

    def sizes(number):
        return plan_crops(photos, reconstruction, PreparationConfig(scales=number)).scales

    usual, three = sizes(None), sizes(3)
    assert (three[0], three[-1]) == pytest.approx((usual[0], usual[-1]))
    assert three[1] == pytest.approx((usual[0] * usual[-1]) ** 0.5)
    assert sizes(1) == pytest.approx([three[1]])
    assert sizes(len(usual)) == pytest.approx(usual)
    with pytest.raises(UserError, match="scales is 0: give a number from 1"):
        PreparationConfig(scales=0).check()


def test_a_range_in_the_world_is_refused_without_points_to_measure_it_by(scene):
    photos, reconstruction = collection(scene)
    no_points = replace(reconstruction, points=reconstruction.points[:0])
    assert plan_crops(photos, no_points, PreparationConfig(scale_range=(0.1, 0.6))).scales[-1] == 0.6
    with pytest.raises(UserError, match="a relative crop is at most 1 photo wide"):
        plan_crops(photos, no_points, PreparationConfig(scale_range=(0.5, 12.0)))


def seen_from_afar(reconstruction):
    """The reconstruction with all cameras so far away, at one angle, that every photo is as wide."""
    photos = {}
    for name, photo in reconstruction.photos.items():
        pose = photo.camera_from_world.copy()
        pose[2, 3] += 1e4
        lens = replace(photo.lens, fx=photo.width, fy=photo.width)
        photos[name] = replace(photo, camera_from_world=pose, lens=lens)
    return replace(reconstruction, photos=photos)


def test_needs_are_written_and_read_back(scene, tmp_path):
    needs = list(verdicts(scene).values())
    write_needs(needs, tmp_path)
    assert read_needs(tmp_path) == {need.component: need.needed for need in needs}
    data = json.loads((tmp_path / "scene_needs.json").read_text())
    assert data["appearance"]["threshold"] == 0.3
    assert all(need.component in needs_table(needs) for need in needs)
    assert read_needs(tmp_path / "elsewhere") == {}


def test_components_left_out_are_absent(train, scene, tmp_path):
    trainer = train(
        scene,
        iterations=2,
        pipeline__datamanager__cache_dir=tmp_path,
        pipeline__model__appearance__use="off",
        pipeline__model__view_dependence="off",
        pipeline__model__camera_optimization="off",
        pipeline__datamanager__dense="none",
        pipeline__datamanager__regions="none",
        pipeline__datamanager__foreground="none",
    )
    model, batch = trainer.pipeline.model, trainer.pipeline.datamanager.next_train(0)[1]
    groups = set(trainer.optimizers.optimizers)
    assert not groups & {"appearance", "appearance_vectors", "camera_opt"}
    assert model.gauss_params["features_rest"].numel() == 0
    assert model.semantic_field.dense_dim == 0
    assert not {"dense_target", "regions", "mask"} & set(batch)
    assert not [name for name in model.state_dict() if "appearance" in name or "camera" in name]
    store = trainer.pipeline.datamanager.data.cache_dir
    assert not (store / "regions").exists()


def test_needed_components_are_built_and_learn(train, scene):
    trainer = train(
        scene,
        iterations=12,
        pipeline__model__appearance__use="on",
        pipeline__model__view_dependence="on",
        pipeline__model__camera_optimization="on",
        pipeline__datamanager__regions="felzenszwalb",
        pipeline__model__decoder__name="paper",  # only codes that are trained with the scene use regions
    )
    model = trainer.pipeline.model
    assert model.gauss_params["features_rest"].shape[1] == 15
    assert model.camera_optimizer.pose_adjustment.abs().max() > 0
    assert "regions" in trainer.pipeline.datamanager.next_train(0)[1]


def test_a_checkpoint_brings_what_it_was_trained_with(train, scene):
    from nerfstudio.utils.eval_utils import eval_setup

    trainer = train(
        scene, iterations=3, pipeline__model__view_dependence="off", pipeline__model__camera_optimization="on"
    )
    _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml", test_mode="test")
    assert pipeline.model.config.sh_degree == 0
    assert torch.equal(
        pipeline.model.camera_optimizer.pose_adjustment,
        trainer.pipeline.model.camera_optimizer.pose_adjustment,
    )


def test_a_resumed_run_keeps_what_auto_meant(train, scene, tiny_clip, tiny_dense, tmp_path):
    first = train(scene, iterations=3)
    needs = json.loads((first.base_dir / "scene_needs.json").read_text())
    longer = make_trainer(
        scene, tiny_clip, tiny_dense, tmp_path, 6_000, load_dir=first.checkpoint_dir
    ).config.pipeline.model
    assert longer.semantic_field.preset == "short"
    assert longer.appearance.use == ("on" if needs["appearance"]["needed"] else "off")
