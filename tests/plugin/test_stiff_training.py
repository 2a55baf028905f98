"""Training with extreme photos and learning rates: every number stays finite."""

import shutil

import pytest
import torch
from runs import all_finite
from scenes import write_scene

from lang3dxl_ns.training import batches

QUIET = {"steps_per_eval_image": 0}


def is_sound(trainer) -> bool:
    """No step was skipped, and the checkpoint holds only finite numbers."""
    state = torch.load(next(trainer.checkpoint_dir.glob("*.ckpt")), weights_only=True)
    codes = state["pipeline"]["_model.gauss_params.codes"]
    assert (codes.isfinite() | codes.isnan().all(1, keepdim=True)).all()  # or unknown
    codes.nan_to_num_(0.0)
    return trainer.guard.skipped == 0 and all_finite(state["pipeline"]) and all_finite(state["optimizers"])


def black(batch):
    batch["image"] = torch.zeros_like(batch["image"])


def no_foreground(batch):
    batch["mask"] = torch.zeros(*batch["image"].shape[:2], 1, dtype=torch.bool)


def overexposed(batch):
    batch["image"] = batch["image"].float() / 255 * 100


def underexposed(batch):
    batch["image"] = batch["image"] // 100


def loud_targets(batch):
    if "clip_target" in batch:  # it is read once, after training
        batch["clip_target"] = 1e4 * batch["clip_target"]


EXTREMES = (black, no_foreground, overexposed, underexposed, loud_targets)


@pytest.fixture
def spoil(monkeypatch):
    """Changes the batches of photos by name; None: of all of them."""

    def install(changes):
        make = batches.to_batch

        def spoilt(data, name, *how):
            batch = make(data, name, *how)
            change = changes.get(name, changes.get(None))
            if change is not None:
                change(batch)
            return batch

        monkeypatch.setattr(batches, "to_batch", spoilt)

    return install


def test_extreme_photos_among_usual_ones_break_nothing(train, scene, spoil):
    spoil({f"photo_{i:03d}.jpg": change for i, change in enumerate(EXTREMES, start=1)})
    changes = {"densify_grad_thresh": 1e-7, "densify_until": 0.3, "appearance__use": "on"}
    changes = {f"pipeline__model__{name}": value for name, value in changes.items()}
    trainer = train(scene, iterations=14, **changes, **QUIET)
    assert is_sound(trainer) and trainer.pipeline.model.num_points > 1_000


@pytest.mark.parametrize("change", EXTREMES, ids=lambda change: change.__name__)
def test_a_collection_of_nothing_but_extreme_photos_breaks_nothing(train, scene, spoil, change):
    spoil({None: change})
    assert is_sound(train(scene, iterations=6, **QUIET))


def test_three_photos_are_enough(train, tmp_path):
    assert is_sound(train(write_scene(tmp_path / "few", photos=3, points=100), iterations=12, **QUIET))


@pytest.mark.parametrize("duplicates", [4, 5])
def test_duplicates_of_a_photo_break_nothing(train, tmp_path, duplicates):
    """Of six; five leave no distance between any two cameras."""
    folder = write_scene(tmp_path / "same", photos=6, points=100, duplicates=duplicates)
    for i in range(6 - duplicates, 6):
        shutil.copy(folder / "images" / "photo_000.jpg", folder / "images" / f"photo_{i:03d}.jpg")
    assert is_sound(train(folder, iterations=8, **QUIET))
