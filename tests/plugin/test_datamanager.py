"""The data manager's photo cache, and cameras that fit the photos as read."""

import shutil
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.plugin.photo_dataset import PhotoDataset
from lang3dxl_ns.preparation import photo_cache
from lang3dxl_ns.preparation.photo_cache import PhotoCache
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.working_photos import WorkingPhotos
from lang3dxl_ns.scene.camera import Lens, view_matrix
from lang3dxl_ns.scene.capture import Capture, Split
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.training.batches import TrainingData
from lang3dxl_ns.training.gaussians import sphere_around


def photo(index: int) -> dict[str, torch.Tensor]:
    return {"image": torch.full((10, 10), index, dtype=torch.uint8)}


def test_cache_returns_the_right_photo_and_stays_within_its_memory():
    cache = PhotoCache(photo, max_bytes=500)
    for step in range(60):
        index = step * 7 % 20
        assert int(cache.get(index, [(index + 7) % 20])["image"][0, 0]) == index
    assert sum(kept["image"].nbytes for kept in cache._kept.values()) == 500
    assert len(cache._ahead) <= 1  # the one read ahead


def test_cache_reads_a_photo_once_while_it_fits():
    reads = []
    cache = PhotoCache(lambda i: reads.append(i) or photo(i), max_bytes=10_000)
    for index in [0, 1, 2, 0, 1, 2]:
        cache.get(index, [(index + 1) % 3])
    assert sorted(reads) == [0, 1, 2]


def test_a_photo_that_failed_in_read_ahead_fails_no_other():
    def read(index):
        if index == 1:
            raise UserError("photo 1 is torn")
        return photo(index)

    cache = PhotoCache(read, max_bytes=150)
    cache.get(0, [1])
    for index in (2, 3, 4, 5):  # evicts the broken photo's entry among the first
        assert int(cache.get(index, [])["image"][0, 0]) == index


def test_the_cache_raises_the_reading_error():
    def broken(index):
        raise UserError(f"photo {index} is torn")

    cache = PhotoCache(broken, max_bytes=1)
    with pytest.raises(UserError, match="photo 3 is torn"):
        cache.get(3, [])


def test_targets_that_vanish_are_waited_for_like_photos(tmp_path, monkeypatch):
    store, waits = FeatureStore(tmp_path), []

    def sleep(seconds):
        waits.append(seconds)
        store.write("clip", "a.jpg", photo(7), {})

    monkeypatch.setattr(photo_cache.time, "sleep", sleep)
    cache = PhotoCache(lambda _: store.read("clip", "a.jpg"), max_bytes=0)
    assert int(cache.get(0, [])["image"][0, 0]) == 7
    assert len(waits) == 1


def test_the_first_that_fit_are_kept_and_the_rest_is_read_ahead_once_per_round():
    reads = []
    cache = PhotoCache(lambda i: reads.append(i) or photo(i), max_bytes=500)
    for seed in range(3):
        order = torch.randperm(20, generator=torch.Generator().manual_seed(seed)).tolist()
        for place, index in enumerate(order):
            assert int(cache.get(index, order[place + 1 : place + 4])["image"][0, 0]) == index
    assert len(reads) == 20 + 2 * 15  # the first round, and then those that don't fit


def test_several_photos_are_read_at_once():
    together = threading.Barrier(3, timeout=60)

    def read(index):
        together.wait()
        return photo(index)

    cache = PhotoCache(read, max_bytes=0, readers=3)
    assert int(cache.get(0, [1, 2])["image"][0, 0]) == 0


@pytest.mark.parametrize(("scale", "exif"), [(1.0, 1), (0.37, 1), (1.0, 6), (0.37, 8), (1.0, 3)])
def test_points_project_to_their_observations_through_the_whole_chain(scene, scale, exif, tmp_path):
    """COLMAP pose and lens → upright photo → dataparser's frame → scaled pinhole: pixels agree with the
    model's tracks, and show the file as EXIF says."""
    if exif != 1:
        scene = shutil.copytree(scene, tmp_path / "scene")
        orientation = Image.Exif()
        orientation[0x0112] = exif
        for path in (scene / "images").glob("*.*"):
            Image.open(path).save(path, exif=orientation, quality=95)
    parser = PhotoCollectionDataParserConfig(data=scene).setup()
    outputs = parser.get_dataparser_outputs(split="train")
    dataset = PhotoDataset(outputs, scale, WorkingPhotos(FeatureStore(scene / "cache")))
    geometries = parser.capture.reconstruction.photos
    transform, world_scale = outputs.dataparser_transform, outputs.dataparser_scale
    for i, taken in enumerate(dataset.photos):
        geometry, camera = geometries[taken.name], dataset.cameras[i]
        image = dataset.read(i)["image"]
        assert image.shape[:2] == (int(camera.height), int(camera.width))
        upright = ImageOps.exif_transpose(Image.open(taken.path).convert("RGB"))
        shown = upright.resize(image.shape[1::-1], Image.Resampling.BILINEAR)
        assert (image.float() - torch.from_numpy(np.array(shown)).float()).abs().mean() < 2
        world = torch.cat([torch.tensor(geometry.points), torch.ones(len(geometry.points), 1)], dim=1).float()
        world = world @ transform.T * world_scale
        view = view_matrix(camera.camera_to_worlds)
        local = world @ view[:3, :3].T + view[:3, 3]
        pixels = local @ camera.get_intrinsics_matrices().T
        pixels = pixels[:, :2] / pixels[:, 2:]
        zoom = torch.tensor([image.shape[1] / geometry.width, image.shape[0] / geometry.height])
        error = (pixels - torch.tensor(geometry.pixels) * zoom).norm(dim=1)
        assert float(error.median()) < 1.0 * scale


def test_sky_surrounds_the_scene_evenly():
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) + 5
    sky = sphere_around(points, 1000)
    radii = (sky - points.median(dim=0).values).norm(dim=1)
    assert float(radii.std() / radii.mean()) < 1e-5
    assert float(radii.min()) > 5 * float((points - 5).norm(dim=1).quantile(0.9))
    assert float((sky.mean(dim=0) - points.median(dim=0).values).norm() / radii.mean()) < 1e-2


def test_thousands_of_unusable_photos_in_a_row_are_passed_over(monkeypatch):
    """More than Python's stack holds calls."""
    names = tuple(str(i) for i in range(3_000))

    def read(index, _ahead):
        if index != len(names) - 1:
            raise UserError("it is damaged")
        return {}

    lens, nothing = Lens(4, 4, 4.0, 4.0, 2.0, 2.0), np.zeros((0, 3))
    photos = [Photo(name, Path(name), None, lens) for name in names]
    seen = {name: TrackedPhoto(name, lens, np.eye(4)[:3], nothing, nothing[:, :2]) for name in names}
    capture = Capture(Path(), photos, Reconstruction(seen, nothing, nothing), known_split=Split(names, names))
    data = TrainingData(capture, PreparationConfig(), Path(), "cpu", False)
    data._cache = SimpleNamespace(get=read)
    monkeypatch.setattr(TrainingData, "_leave_out", lambda *_: None)
    assert data.next()[1]["name"] == names[-1]
