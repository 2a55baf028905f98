"""Scoring of predicted maps: values by hand, and errors that name the file."""

import json
from pathlib import Path

import numpy as np
import pytest
from label_sets import box_object, write_holyscenes, write_labels, write_plain
from PIL import Image

from lang3dxl_ns import cli
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.layouts import MaskFile, read_gray
from lang3dxl_ns.evaluation.predictions import score_predictions
from lang3dxl_ns.evaluation.scores import average_precision

RNG = np.random.default_rng(0)


@pytest.fixture
def mask():
    mask = np.zeros((40, 60), bool)
    mask[8:24, 16:48] = True
    return mask


@pytest.fixture
def scene(tmp_path, mask):
    """Ground truth of two photos, and maps: perfect for the first, random for the second."""
    truth, maps = tmp_path / "milano", tmp_path / "maps"
    write_plain(truth, "rose window", "0001", mask)
    write_plain(truth, "rose window", "0002", mask)
    write_plain(truth, "spires", "0002", np.zeros_like(mask))
    write_map(maps, "rose window", "0001", mask.astype(np.float32))
    write_map(maps, "rose window", "0002", RNG.random((20, 30)))
    write_map(maps, "spires", "0002", RNG.random((20, 30)))
    return truth, maps


def write_map(folder, prompt, photo, score):
    path = folder / prompt / f"{photo}.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, score)
    return path


def test_every_photo_has_its_figures_and_the_protocol_says_what_was_done(scene, mask):
    truth, maps = scene
    photos, protocol = score_predictions(GroundTruth(truth), maps)
    assert photos["0001"]["raw_ap_rose window"] == 1
    random = np.load(maps / "rose window" / "0002.npy").astype(np.float32)
    assert photos["0002"]["raw_ap_rose window"] == pytest.approx(average_precision(random, mask[::2, ::2]))
    assert protocol["photos_without_positives"] == {"spires": 1}
    assert protocol["prompts_without_photos"] == ["spires"]
    assert protocol["layout"] == "plain" and "none" in protocol["foreground"]


def test_a_photo_that_is_named_twice_counts_once(scene):
    truth, maps = scene
    figures, protocol = score_predictions(GroundTruth(truth), maps, ["0001", "0001.jpg"])
    assert list(figures) == ["0001"] and protocol["evaluated_photos"] == 1


def test_pictures_score_as_floats_do(scene, tmp_path):
    truth, maps = scene
    expected = score_predictions(GroundTruth(truth), maps)[0]["0001"]
    (maps / "rose window" / "0001.npy").unlink()
    score = np.zeros((40, 60), np.uint8)
    score[8:24, 16:48] = 255
    Image.fromarray(score).save(maps / "rose window" / "0001.png")
    assert score_predictions(GroundTruth(truth), maps)[0]["0001"] == pytest.approx(expected)


def test_pictures_of_16_bits_are_not_clipped_at_255_and_floats_are_refused(tmp_path):
    ramp = np.linspace(0, 65535, 1200).reshape(30, 40)
    Image.fromarray(ramp.astype(np.uint16)).save(tmp_path / "a.png")
    np.testing.assert_allclose(np.asarray(read_gray(tmp_path / "a.png")), ramp / 257, atol=0.51)
    Image.fromarray((ramp > 30000).astype(np.uint16) * 255).save(tmp_path / "b.png")  # a mask of 0 and 255
    np.testing.assert_array_equal(np.asarray(read_gray(tmp_path / "b.png")) == 255, ramp > 30000)
    Image.fromarray((ramp / 65535).astype(np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(UserError, match=r"a\.tif.*floating-point"):
        read_gray(tmp_path / "a.tif")


@pytest.mark.parametrize(("color", "dark"), [(255, False), (0, True)])
def test_what_is_transparent_is_not_the_object(tmp_path, mask, color, dark):
    """As programs that cut things out save them."""
    colors = np.full((*mask.shape, 3), color, np.uint8)
    cut = np.concatenate([colors, mask[..., None] * np.uint8(255)], axis=2)
    Image.fromarray(cut).save(tmp_path / "a.png")
    np.testing.assert_array_equal(MaskFile(tmp_path / "a.png", dark).truth(mask.shape).mask, mask)


def test_the_names_of_query_are_understood(scene):
    truth, maps = scene
    expected, _ = score_predictions(GroundTruth(truth), maps)
    (maps / "rose window").rename(maps / "rose-window")
    assert score_predictions(GroundTruth(truth), maps)[0] == expected


def test_masks_cut_predictions_and_are_stated(scene, tmp_path, mask):
    truth, maps = scene
    folder = tmp_path / "masks"
    folder.mkdir()
    for photo in ("0001", "0002"):
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / f"{photo}.png")
    photos, protocol = score_predictions(GroundTruth(truth), maps, masks=folder)
    assert photos["0002"]["raw_ap_rose window"] == 1  # all that is left lies on the object
    assert "masks of 2 of 2 photos" in protocol["foreground"]
    (folder / "0002.png").unlink()
    with pytest.raises(UserError, match="no mask of the photo 0002"):
        score_predictions(GroundTruth(truth), maps, masks=folder)


@pytest.mark.parametrize("name", ["0002.png", "0002.JPG.png", "0002_mask.tif"])
@pytest.mark.parametrize("values", ["255", "1", "palette"])
def test_masks_are_read_as_training_reads_them(scene, tmp_path, mask, name, values):
    truth, maps = scene
    (tmp_path / "masks").mkdir()
    image = Image.fromarray(mask.astype(np.uint8) * np.uint8(255 if values == "255" else 1))
    if values == "palette":
        image = Image.fromarray(mask.astype(np.uint8), "P")
        image.putpalette([0, 0, 0, 90, 0, 0])
    image.save(tmp_path / "masks" / name)
    photos, _ = score_predictions(GroundTruth(truth), maps, ["0002"], tmp_path / "masks")
    assert photos["0002"]["raw_ap_rose window"] == 1
    image.transpose(Image.Transpose.ROTATE_90).save(tmp_path / "masks" / name)
    with pytest.raises(UserError, match=rf"{name} has 40 × 60 pixels.*another aspect ratio"):
        score_predictions(GroundTruth(truth), maps, ["0002"], tmp_path / "masks")


def test_only_the_photos_that_are_asked_for_are_scored(scene):
    truth, maps = scene
    (maps / "rose window" / "0002.npy").unlink()
    assert list(score_predictions(GroundTruth(truth), maps, ["images/0001.jpg"])[0]) == ["0001"]
    with pytest.raises(UserError, match="0003 has no label"):
        score_predictions(GroundTruth(truth), maps, ["0003"])


def test_a_missing_map_is_named(scene):
    truth, maps = scene
    (maps / "spires" / "0002.npy").unlink()
    with pytest.raises(UserError, match=r"make .*spires/0002\.npy"):
        score_predictions(GroundTruth(truth), maps)
    with pytest.raises(UserError, match="nowhere is not a folder"):
        score_predictions(GroundTruth(truth), maps / "nowhere")


@pytest.mark.parametrize(
    ("score", "message"),
    [
        (np.zeros(7), r"has shape \(7,\)"),
        (np.zeros((0, 7)), r"has shape \(0, 7\)"),
        (np.full((20, 30), np.nan), "NaN"),
        (np.full((20, 30), 1e300), "infinity"),
        (np.zeros((20, 30), complex), "not numbers"),
        (np.array([[{}] * 30] * 20), "can't be read"),  # needs pickle, which can run code
        (np.zeros((30, 20)), "another aspect ratio"),
    ],
)
def test_an_invalid_map_is_named(scene, score, message):
    truth, maps = scene
    path = write_map(maps, "spires", "0002", score)
    with pytest.raises(UserError, match=message) as error:
        score_predictions(GroundTruth(truth), maps)
    assert str(path) in str(error.value)


def test_levels_are_scored_by_the_strongest(tmp_path):
    write_labels(tmp_path / "label", "0001", [box_object("bear", 10, 10, 39, 29)])
    levels = np.zeros((3, 40, 60))
    levels[1, 10:30, 10:40] = 1
    write_map(tmp_path / "maps", "bear", "0001", levels)
    photos, _ = score_predictions(GroundTruth(tmp_path / "label"), tmp_path / "maps")
    assert photos["0001"]["ap_bear"] == photos["0001"]["smooth_located_bear"] == 1


# ── the command ─────────────────────────────────────────────────────────────────────────────────────────


def test_the_command_reports_and_reports_are_put_together(scene, tmp_path, mask, capsys):
    truth, maps = scene
    one, two, both = (tmp_path / name for name in ("one", "two", "both"))
    cli.main(["evaluate", "maps", "--maps", str(maps), "--ground-truth", str(truth), "--out", str(one)])
    report = json.loads((one / "scores.json").read_text())
    assert report["scene"] == "milano"
    assert report["results"]["ap_rose window_photos"] == 2
    assert "| rose window | 2 |" in (one / "scores.md").read_text()
    assert "photos without positives: {'spires': 1}" in capsys.readouterr().out

    other = tmp_path / "st_paul"
    write_plain(other, "rose window", "0001", mask)
    arguments = ["evaluate", "maps", "--maps", str(maps), "--ground-truth", str(other), "--out", str(two)]
    cli.main(arguments)
    reports = [str(one / "scores.json"), str(two / "scores.json")]
    cli.main(["evaluate", "pool", "--reports", *reports, "--out", str(both)])
    pooled = json.loads((both / "scores.json").read_text())
    figures = [json.loads(Path(path).read_text())["results"] for path in reports]
    by_scene = [results["ap_rose window"] for results in figures]
    assert pooled["scene_mean"]["map"] == pytest.approx(sum(by_scene) / 2)
    assert pooled["image_pooled"]["map"] == pytest.approx((2 * by_scene[0] + by_scene[1]) / 3)
    assert set(pooled["protocols"]) == {"milano", "st_paul"}

    for out in (one, tmp_path / "two" / ".." / "two"):
        with pytest.raises(SystemExit, match=r"scores\.json would be written over"):
            cli.main(["evaluate", "pool", "--reports", *reports, "--out", str(out)])
    assert json.loads((one / "scores.json").read_text()) == report
    with pytest.raises(SystemExit, match="second report of the scene milano"):
        cli.main(["evaluate", "pool", "--reports", reports[0], reports[0], "--out", str(both)])
    (tmp_path / "other.json").write_text('{"results": {}}')
    with pytest.raises(SystemExit, match=r"other\.json is not a report"):
        cli.main(["evaluate", "pool", "--reports", str(tmp_path / "other.json"), "--out", str(both)])


def test_the_list_of_photos_to_hold_out_is_a_list_of_photos_to_score(scene, tmp_path, mask):
    truth, maps = scene
    names = tmp_path / "held_out.txt"
    cli.main(["evaluate", "split", "--ground-truth", str(truth), "--out", str(names)])
    names.write_text(names.read_text().replace("0001\n", ""))
    assert names.read_text() == "0002\n"
    common = ["--maps", str(maps), "--ground-truth", str(truth), "--photos", str(names)]
    cli.main(["evaluate", "maps", *common, "--out", str(tmp_path / "out")])
    report = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert list(report["results"]["photos"]) == ["0002"]
    names.write_text("# nothing\n\n")
    with pytest.raises(SystemExit, match="is empty"):
        cli.main(["evaluate", "maps", *common, "--out", str(tmp_path / "out")])


@pytest.mark.parametrize("name", ["castle #1", "#1"])
def test_a_list_that_would_be_read_otherwise_is_not_written(tmp_path, mask, name):
    for photo in ("castle", name, "a#b"):
        write_plain(tmp_path / "truth", "rose window", photo, mask)
    arguments = ["evaluate", "split", "--ground-truth", str(tmp_path / "truth"), "--out", str(tmp_path / "a")]
    with pytest.raises(SystemExit, match=rf"rename .*: {name}$"):
        cli.main(arguments)
    (tmp_path / "truth" / "rose window" / f"{name}.png").unlink()
    cli.main(arguments)
    assert (tmp_path / "a").read_text() == "a#b\ncastle\n"


def test_labels_that_mark_nothing_are_told(scene, tmp_path, mask):
    truth, maps = tmp_path / "black", scene[1]
    write_plain(truth, "rose window", "0001", np.zeros_like(mask))
    for words in (
        ["maps", "--maps", str(maps), "--out", str(tmp_path)],
        ["split", "--out", str(tmp_path / "a")],
    ):
        with pytest.raises(SystemExit, match=r"no label .*marks a pixel.*white on black"):
            cli.main(["evaluate", *words, "--ground-truth", str(truth)])
    assert (tmp_path / "scores.json").is_file() and not (tmp_path / "a").exists()


def test_the_temperature_of_maps_matters_to_the_published_processing_alone(scene):
    truth, maps = scene
    steep, _ = score_predictions(GroundTruth(truth), maps, ["0002"], temperature=10)
    plain, _ = score_predictions(GroundTruth(truth), maps, ["0002"])
    differ = {name for name in plain["0002"] if plain["0002"][name] != steep["0002"][name]}
    assert "authors_ap_rose window" in differ and all(name.startswith("authors_") for name in differ)


def test_holyscenes_masks_are_scored_at_half_their_size(tmp_path, mask):
    write_holyscenes(tmp_path / "truth", "domes", "0001", mask, quality=95)
    write_map(tmp_path / "maps", "domes", "0001", mask[::2, ::2].astype(np.float32))
    photos, protocol = score_predictions(GroundTruth(tmp_path / "truth"), tmp_path / "maps")
    assert photos["0001"]["raw_iou_domes"] == 1
    assert protocol["scored_at"] == "half the labels' size"
