"""`ns-eval` and `lang3dxl evaluate run`: their reports, and lists of held-out photos."""

import json
import shutil

import numpy as np
import pytest
import torch
from label_sets import box_object, write_labels, write_plain
from PIL import Image
from runs import train_run
from scenes import write_scene

from lang3dxl_ns import cli
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.ground_truth import GroundTruth, find_ground_truth
from lang3dxl_ns.evaluation.score_scene import score_scene
from lang3dxl_ns.files.scene_file import write_scene as write_scene_file
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.plugin.load_scene import load_run
from lang3dxl_ns.plugin.trainer_config import open_run
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.capture import Capture, CaptureSettings
from lang3dxl_ns.scene.colmap import Reconstruction
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.words.taught_words import TaughtWord


def label(scene, folder, numbers):
    """A dome in the left half of these photos."""
    for number in numbers:
        width, height = Image.open(scene / "images" / f"photo_{number:03d}.jpg").size
        mask = np.zeros((height, width), bool)
        mask[:, : width // 2] = True
        write_plain(folder, "dome", f"photo_{number:03d}", mask)
    return folder


@pytest.fixture(scope="module")
def trainer(scene, tiny_clip, tiny_dense, tmp_path_factory):
    """A finished run of two steps, to evaluate."""
    return train_run(scene, tiny_clip, tiny_dense, tmp_path_factory.mktemp("run"), iterations=2)


@pytest.fixture
def evaluate(trainer, monkeypatch):
    """What ns-eval calls, after changes to the pipeline's configuration."""
    pipeline = trainer.pipeline

    def run(**changes):
        pipeline.__dict__.pop("evaluation", None)
        for name, value in changes.items():
            monkeypatch.setattr(pipeline.config, name, value)
        return pipeline.get_average_eval_image_metrics(get_std=True)

    return run


def test_ns_eval_reports_pictures_features_words_and_cost(evaluate, scene, tmp_path):
    results = evaluate(ground_truth=label(scene, tmp_path / "truth", range(12)))
    names = {
        "psnr",
        "ssim",
        "clip_l1",
        "clip_psnr",
        "clip_cosine",
        "ap_dome",
        "raw_ap_dome",
        "authors_ap_dome",
    }
    names |= {"teacher_ap_dome", "iou_dome", "render_seconds", "query_seconds"}
    assert names | {f"{name}_std" for name in names} <= set(results)
    assert {"map", "raw_map", "authors_map", "teacher_map", "miou", "localization_accuracy"} <= set(results)
    assert results["peak_memory_mb"] > 10
    assert results["ap_dome_photos"] == 2
    protocol = results["protocol"]
    assert (protocol["evaluated_photos"], protocol["seen_in_training"]) == (2, 0)
    assert protocol["foreground"] == "none"
    assert set(results["photos"]) == {"photo_000.jpg", "photo_008.jpg"}
    json.dumps(results, allow_nan=False)


def test_a_lens_that_distorts_is_not_counted_as_masks(tmp_path, tiny_clip):
    """Undistorted photos have pixels without content at their border, which are masked as well."""
    folder = write_scene(tmp_path / "bent", distortion=(0.3, 0.1, 0.0, 0.0))
    trainer = train_run(folder, tiny_clip, "none", tmp_path / "run", iterations=2)
    pipeline = trainer.pipeline
    pipeline.config.ground_truth = label(folder, tmp_path / "truth", range(6))
    results = pipeline.get_average_eval_image_metrics(get_std=True)
    assert "mask" in next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))[1]
    assert results["protocol"]["foreground"] == "none"


def test_photos_that_training_saw_are_scored_on_request_and_said_to_be(evaluate, scene, tmp_path):
    results = evaluate(ground_truth=label(scene, tmp_path / "truth", (0, 1, 2)), evaluated_photos="seen")
    assert set(results["photos"]) == {"photo_001.jpg", "photo_002.jpg"}
    assert (results["protocol"]["evaluated_photos"], results["protocol"]["seen_in_training"]) == (2, 2)
    with pytest.raises(UserError, match="none of the training photos has a label"):
        evaluate(ground_truth=label(scene, tmp_path / "held_out", (0, 8)))


def test_labels_of_other_scenes_are_refused_and_absent_photos_named(evaluate, scene, tmp_path, capsys):
    write_plain(tmp_path / "truth", "dome", "0001", np.ones((72, 96), bool))
    with pytest.raises(UserError, match=r"no label in .* belongs to a photo of the scene"):
        evaluate(ground_truth=tmp_path / "truth")
    evaluate(ground_truth=label(scene, tmp_path / "truth", (0,)))
    assert "scene and are not scored: 0001" in " ".join(capsys.readouterr().out.split())


def test_a_mask_of_another_shape_is_named(evaluate, scene, tmp_path):
    write_plain(tmp_path / "truth", "dome", "photo_000", np.ones((40, 200), bool))
    with pytest.raises(UserError, match=r"photo_000\.png has 200 × 40 pixels"):
        evaluate(ground_truth=tmp_path / "truth")


def test_labels_in_json_are_scored_at_the_photos_size_by_langsplats_measures(evaluate, scene, tmp_path):
    width, height = Image.open(scene / "images" / "photo_000.jpg").size
    truth, box = tmp_path / "truth", box_object("dome", 5, 5, 30, 30)
    write_labels(truth, "photo_000", [box], width=width, height=height)
    results = evaluate(ground_truth=truth)
    assert {"smooth_localization_accuracy", "smooth_miou", "localization_accuracy"} <= set(results)
    assert {"mpa", "mp", "smooth_mpa", "smooth_mp"} <= set(results)
    assert results["protocol"]["layout"] == "lerf_ovs"


def test_evaluate_run_writes_the_report_of_a_run(trainer, scene, tmp_path):
    truth = label(scene, tmp_path / "truth", (0, 1))
    config = str(trainer.base_dir / "config.yml")
    common = ["evaluate", "run", config, "--ground-truth", str(truth), "--split", "seen"]
    cli.main([*common, "--out", str(tmp_path / "out")])
    report = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert list(report["results"]["photos"]) == ["photo_001.jpg"]
    assert "| dome | 1 |" in (tmp_path / "out" / "scores.md").read_text()
    assert "taught_words_left_out" not in report["results"]["protocol"]


def test_a_scene_file_is_scored_with_the_clip_that_is_named_and_a_run_with_its_own(trainer, scene, tmp_path):
    truth, (file,) = label(scene, tmp_path / "truth", (0, 1)), trainer.base_dir.glob("*.scene")
    for place, message in (
        (file, "is not the one that this scene was made with"),
        (file.parent, "--clip is for"),
    ):
        words = ["evaluate", "run", str(place), "--ground-truth", str(truth), "--out", str(tmp_path / "out")]
        with pytest.raises(SystemExit, match=message):
            cli.main([*words, "--clip", "builtin"])


def test_a_run_is_scored_by_text_alone_and_says_which_taught_words_that_leaves_out(
    trainer, scene, tmp_path, capsys, monkeypatch
):
    run = tmp_path / "outputs" / "a" / "lang3dxl" / "first"
    shutil.copytree(trainer.base_dir, run)
    for file in run.glob("*.scene"):
        file.unlink()
    loaded = load_run(trainer.base_dir)
    word = TaughtWord(
        "gizmo", torch.ones(loaded.decoder.clip_dim), 0.0, 0.0, 0.1, clip=loaded.file.clip_identity
    )
    write_scene_file(run / "a.scene", loaded.with_words([word]))
    truth, figures = label(scene, tmp_path / "truth", (0, 1)), []
    monkeypatch.chdir(tmp_path)
    for named in (str(trainer.base_dir), str(run), None):  # None: the newest below outputs/
        words = ["evaluate", "run", *filter(None, [named]), "--ground-truth", str(truth), "--split", "seen"]
        cli.main([*words, "--out", str(tmp_path / "out")])
        results = json.loads((tmp_path / "out" / "scores.json").read_text())["results"]
        figures.append(results["photos"]["photo_001.jpg"]["ap_dome"])
        told = "what examples taught (gizmo) counts where the .scene file is named" in capsys.readouterr().out
        left_out = results["protocol"].get("taught_words_left_out", [])
        assert (left_out, told) == (([], False) if named == str(trainer.base_dir) else (["gizmo"], True))
    assert figures == pytest.approx(figures[:1] * 3)


# ── held-out photos by list ─────────────────────────────────────────────────────────────────────────────


def split(scene, names, tmp_path):
    path = tmp_path / "held_out.txt"
    path.write_text(names)
    parser = PhotoCollectionDataParserConfig(data=scene, held_out=path).setup()
    return [
        [photo.name for photo in parser.get_dataparser_outputs(part).metadata["photos"]]
        for part in ("train", "test")
    ]


def test_listed_photos_and_no_others_are_held_out(scene, tmp_path):
    train_photos, held_out = split(scene, "photo_003\nphoto_001.jpg  # a comment\n", tmp_path)
    assert held_out == ["photo_001.jpg", "photo_003.jpg"]
    assert len(train_photos) == 10 and not set(train_photos) & set(held_out)


def test_a_listed_photo_that_is_not_there_is_named(scene, tmp_path):
    with pytest.raises(UserError, match=r"names \['photo_099'\], which fits no photo"):
        split(scene, "photo_099\n", tmp_path)


def listed(folder, *names):
    """A capture of such photos, of which the list in the folder is held out."""
    lens, nothing = Lens(4, 4, 4.0, 4.0, 2.0, 2.0), np.zeros((0, 3))
    photos = [Photo(name, folder / name, None, lens) for name in names]
    settings = CaptureSettings(held_out=folder / "held_out.txt")
    return Capture(folder, photos, Reconstruction({}, nothing, nothing), settings=settings)


@pytest.mark.parametrize("name", ["seq/b.jpg", "seq/b", "b.jpg", "b"])
def test_a_photo_may_be_listed_without_its_folder_and_its_suffix(tmp_path, name):
    (tmp_path / "held_out.txt").write_text(name)
    assert listed(tmp_path, "seq/a.jpg", "seq/b.jpg").split == (("seq/a.jpg",), ("seq/b.jpg",))


def test_folders_of_pt_ovs_are_read_as_published(scene, tmp_path):
    """brandenburg_gate/dense/{images,sparse} and label/brandenburg_gate/<photo>.json beside it."""
    data = tmp_path / "brandenburg_gate"
    shutil.copytree(scene / "images", data / "dense" / "images")
    shutil.copytree(scene / "sparse" / "0", data / "dense" / "sparse")
    write_labels(tmp_path / "label" / data.name, "photo_000", [box_object("column", 5, 5, 30, 30)])
    outputs = PhotoCollectionDataParserConfig(data=data).setup().get_dataparser_outputs("test")
    truth = GroundTruth(find_ground_truth(data))
    assert [truth.key(photo.name) for photo in outputs.metadata["photos"]] == ["photo_000", None]


def test_a_scene_alone_has_the_scores_of_its_run(evaluate, trainer, scene, tmp_path):
    folder = label(scene, tmp_path / "truth", range(12))
    expected = evaluate(ground_truth=folder)["photos"]
    found, protocol = score_scene(load_run(trainer.base_dir), GroundTruth(folder), "held-out")
    assert set(found) == set(expected) and protocol["prompts"] == ["dome"]
    for photo, figures in found.items():
        for name in ("ap_dome", "raw_ap_dome", "authors_ap_dome", "iou_dome"):
            assert figures[name] == pytest.approx(expected[photo][name], abs=1e-5)


def test_a_run_of_other_photos_keeps_its_cameras_and_is_not_evaluated(train, tmp_path):
    """nerfstudio would turn and shift the cameras, and hold other photos out."""
    data = write_scene(tmp_path / "scene", photos=10, points=60)
    trainer = train(data, iterations=2)
    recorded = {p.name: p.pose for p in trainer.pipeline.scene_file.photos}

    def opened():
        pipeline = open_run(trainer.base_dir)[1]
        dataset = pipeline.datamanager.train_dataset
        for photo, pose in zip(dataset.photos, dataset.cameras.camera_to_worlds, strict=True):
            np.testing.assert_allclose(pose, recorded[photo.name][:3], atol=1e-5)
        return pipeline

    (away := tmp_path / "away").mkdir()
    for name in ("photo_001.jpg", "photo_002.jpg", "photo_003.jpg"):
        (data / "images" / name).rename(away / name)
    pipeline = opened()
    assert len(pipeline.datamanager.train_dataset) == len(trainer.pipeline.datamanager.train_dataset)
    with pytest.raises(UserError, match="can't be evaluated without the photos"):
        pipeline.evaluation.scored()
    for path in away.iterdir():
        path.rename(data / "images" / path.name)
    assert "psnr" in opened().evaluation.scored()


def test_a_photo_listed_by_its_whole_name_is_that_one(tmp_path):
    """Also if another folder holds one of the same file name."""
    (tmp_path / "held_out.txt").write_text("a.jpg\nday/b.jpg")
    found = listed(tmp_path, "a.jpg", "day/a.jpg", "day/b.jpg", "day/b.png")
    assert found.split.held_out == ("a.jpg", "day/b.jpg")
