"""The published benchmarks: scenes found in each layout, resume, and tables beside the published figures."""

import json
import shutil

import numpy as np
import pytest
from label_sets import box_object, write_labels

from lab.benchmarks.kept_runs import KeptRuns
from lab.benchmarks.published import HolyScenes, LerfOvs, PtOvs, published_figures
from lab.landmark.scene_writer import DemoScene, write_scene
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.common.presets import load_preset
from lang3dxl_ns.evaluation.ground_truth import GroundTruth

SMALL = {"clip": "builtin", "scale": 1.0, "ns_train": "--pipeline.model.decoder.compression.steps 40"}
"""Learning codes from photos takes 15 seconds otherwise, whatever the number of iterations."""


@pytest.fixture(scope="session")
def landmark(tmp_path_factory):
    """A tiny landmark with masks of every second photo, in the layout of HolyScenes."""
    folder = tmp_path_factory.mktemp("landmark") / "scene"
    return write_scene(DemoScene(out=folder, seed=5, photos=8, test_views=0, width=96, height=72, workers=1))


def as_holyscenes(landmark, root, scene="milano"):
    """milano/images and sparse/0; HolyScenes/cathedral/milano/windows/0002-gt.jpg …"""
    shutil.copytree(landmark / "images", root / scene / "images")
    shutil.copytree(landmark / "sparse", root / scene / "sparse")
    shutil.copytree(landmark / "ground_truth", root / "HolyScenes" / "cathedral" / scene)
    return root


def as_labels(landmark, root, scene, dense):
    """teatime/images and sparse/0 (or …/dense/images, dense/sparse); label/teatime/0002.json."""
    photos = root / scene / "dense" if dense else root / scene
    shutil.copytree(landmark / "images", photos / "images")
    shutil.copytree(landmark / "sparse" / "0", photos / "sparse" if dense else photos / "sparse" / "0")
    truth = GroundTruth(landmark / "ground_truth")
    for photo in truth.labeled:
        height, width = truth.size(photo)
        objects = []
        for category, mask in truth.masks(photo, (height, width)).items():
            if mask.any():
                rows, columns = np.nonzero(mask)
                edges = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
                objects.append(box_object(category, *map(float, edges)))
        write_labels(root / "label" / scene, photo, objects, width=width, height=height)
    return root


@pytest.fixture(params=["holyscenes", "lerf-ovs", "pt-ovs"])
def downloaded(request, landmark, tmp_path):
    """A benchmark and a folder of one scene in its layout."""
    if request.param == "holyscenes":
        return HolyScenes, as_holyscenes(landmark, tmp_path / "data"), "milano"
    if request.param == "lerf-ovs":
        return LerfOvs, as_labels(landmark, tmp_path / "data", "teatime", dense=False), "teatime"
    return PtOvs, as_labels(landmark, tmp_path / "data", "brandenburg_gate", dense=True), "brandenburg_gate"


def table(out, name):
    """Rows of the first table, by category, each by column."""
    lines = (out / f"{name}.md").read_text().split("## Scenes")[1].split("##")[0].strip().splitlines()
    heads, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines if "|" in line)
    return {row[1]: dict(zip(heads, row, strict=True)) for row in rows}


@pytest.mark.nightly
def test_a_downloaded_folder_becomes_a_table(downloaded, tmp_path):
    benchmark, data, scene = downloaded
    out = tmp_path / "out"
    benchmark(data=data, out=out, iterations=4, **SMALL).main()
    results = json.loads((out / scene / "scores.json").read_text())["results"]
    assert results["protocol"]["seen_in_training"] == results["protocol"]["evaluated_photos"] == 4
    rows = table(out, benchmark.name)
    counts = [name for name in results if name.startswith("ap_") and name.endswith("_photos")]
    assert set(rows) == {name.removeprefix("ap_").removesuffix("_photos") for name in counts} | {"all"}
    column = "AP, blurred" if benchmark is HolyScenes else "AP"
    assert rows["windows"][column] == f"{results['ap_windows']:.3f}"
    assert rows["all"][column] == f"{results['map']:.3f}"


@pytest.mark.slow
def test_finished_scenes_are_kept_stopped_ones_go_on_and_other_settings_begin_anew(landmark, tmp_path):
    out = tmp_path / "out" / "milano"
    log, report = out / "finished.log", out / "scores.json"
    data = as_holyscenes(landmark, tmp_path / "data")
    command = HolyScenes(data=data, out=out.parent, iterations=8, **SMALL)
    command.main()
    results = json.loads(report.read_text())["results"]
    (run,) = out.glob("runs/*/lang3dxl/*/config.yml")
    (checkpoint,) = run.parent.glob("nerfstudio_models/*.ckpt")
    made = {path: path.stat().st_mtime_ns for path in (checkpoint, report)}
    command.main()
    assert made == {path: path.stat().st_mtime_ns for path in made}

    # stopped while scoring: the training is not repeated, and the figures are the same
    report.unlink()
    command.main()
    again = json.loads(report.read_text())["results"]
    assert checkpoint.stat().st_mtime_ns == made[checkpoint]
    assert again["map"] == pytest.approx(results["map"], abs=1e-6)

    # stopped at iteration 8 of 12
    settings = out / "made_with.json"
    settings.write_text(json.dumps(json.loads(settings.read_text()) | {"iterations": 12}))
    command.iterations = 12
    command.main()
    assert "Resuming at iteration 8 of 12" in log.read_text()

    # other settings
    command.iterations = 4
    command.main()
    assert "Resuming" not in log.read_text()
    assert [path.name for path in run.parent.glob("nerfstudio_models/*.ckpt")] == ["step-000000003.ckpt"]


# ── without training ────────────────────────────────────────────────────────────────────────────────────


def fake(results):
    """`KeptRuns._submit` that takes no time: scores by scene, or a reason to fail."""

    def submit(self, run, log):
        if isinstance(results[run.label], str):
            raise UserError(results[run.label])
        write_atomically(
            self.kept(run) / "scores.json", json.dumps({"scene": run.label, "results": results[run.label]})
        )
        return {"map": results[run.label]["map"]}

    return submit


def scores(**photos):
    """Results of a scene from each photo's AP of windows."""
    mean = float(np.mean(list(photos.values())))
    figures = {name: {"authors_ap_windows": v, "ap_windows": v} for name, v in photos.items()}
    protocol = {"evaluated_photos": len(photos), "seen_in_training": len(photos), "foreground": "none"}
    return {
        "map": mean,
        "authors_map": mean,
        "ap_windows": mean,
        "authors_ap_windows": mean,
        "ap_windows_photos": len(photos),
        "photos": figures,
        "protocol": protocol,
    }


@pytest.fixture
def two_scenes(landmark, tmp_path, monkeypatch):
    monkeypatch.setattr(KeptRuns, "_clip_weights", "some")
    as_holyscenes(landmark, tmp_path / "data", "milano")
    as_holyscenes(landmark, tmp_path / "data", "St_Paul")
    return HolyScenes(data=tmp_path / "data", out=tmp_path / "out")


def test_ours_stand_beside_the_published_figures_of_their_scene_and_category(two_scenes, monkeypatch):
    found = {"milano": scores(a=0.1, b=0.2, c=0.3), "St_Paul": scores(a=0.9)}
    monkeypatch.setattr(KeptRuns, "_submit", fake(found))
    two_scenes.main()
    text = (two_scenes.out / "holyscenes.md").read_text()
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if "|" in line]
    heads = lines[0]
    rows = {(line[0], line[1]): dict(zip(heads, line, strict=False)) for line in lines}
    for scene, ours, theirs in (("milano", "0.200", "0.740"), ("St_Paul", "0.900", "0.720")):
        row = rows[scene, "windows"]
        assert row["AP as published"] == ours and row["Lang3D-XL, published"] == theirs
    together = text.split("## All scenes")[1]
    assert "| photos pooled | windows | 4 | 0.375 |" in together
    assert "| mean of scenes | windows | " in together and "| 0.550 |" in together
    assert "0.510" in together  # Lang3D-XL's windows over all scenes
    assert "fine-tuned on landmarks" in text and "4 labeled photos" not in text


@pytest.mark.parametrize("method", ["lang3dxl", "lang3dxl-paper"])
def test_each_scene_is_trained_with_its_own_published_flags(two_scenes, monkeypatch, method):
    seen = {}

    def submit(self, run, log):
        seen[run.label] = (run.steps, self.settings.flags, self.truth.name, run.row)
        raise UserError("enough")

    monkeypatch.setattr(KeptRuns, "_submit", submit)
    two_scenes.method, two_scenes.ns_train = method, "--pipeline.model.clip-weight 2"
    two_scenes.main()
    for scene, preset in (("milano", "milano"), ("St_Paul", "st_paul")):
        steps, flags, truth, row = seen[scene]
        assert steps == load_preset(f"holyscenes/{preset}")["train"]["max-num-iterations"] == 70_000
        assert f"--pipeline.datamanager.scale-preset holyscenes/{preset}" in flags
        assert flags.endswith("--pipeline.model.clip-weight 2")
        assert row.method == method
        assert truth == scene


def test_a_scene_that_fails_is_named_and_the_others_go_on(two_scenes, monkeypatch):
    found = {"milano": "out of memory", "St_Paul": scores(a=0.5)}
    monkeypatch.setattr(KeptRuns, "_submit", fake(found))
    two_scenes.main()
    text = (two_scenes.out / "holyscenes.md").read_text()
    assert "Not run: milano: out of memory" in text and "| St_Paul | windows | 1 | 0.500 |" in text


def test_what_is_not_found_is_told_with_what_is(two_scenes, tmp_path):
    two_scenes.scenes = ("hurba",)
    with pytest.raises(UserError, match="has no hurba: there are milano, St_Paul"):
        two_scenes.main()
    shutil.rmtree(tmp_path / "data" / "HolyScenes")
    with pytest.raises(UserError, match=r"photos of St_Paul, milano, labels of none"):
        two_scenes.main()
    with pytest.raises(UserError, match="is not a folder"):
        HolyScenes(data=tmp_path / "nowhere", out=tmp_path / "out").main()


def test_published_figures_are_of_scenes_and_categories_that_the_presets_name():
    figures = published_figures("holyscenes")
    assert sum(len(scene) for scene in figures["scenes"].values()) == 18
    for scene in figures["scenes"]:
        load_preset(f"holyscenes/{scene}")
    for system in ("HaLo-NeRF", "Lang3D-XL"):
        rows = [row[system] for name, row in figures["all"].items() if name != "mean"]
        assert np.mean(rows) == pytest.approx(figures["all"]["mean"][system], abs=0.01)
