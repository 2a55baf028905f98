"""Labeled photos to train on: classes, sky, another light; what their labels leave open teaches nothing."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from lab.clip_training.captions import CLASS, CLASSES, GENERIC, UNLABELED, Caption
from lab.clip_training.contrastive import contrastive_loss, in_doubt
from lab.clip_training.crops import draw_crops, join, label_shares, main_materials, soft_labels
from lab.clip_training.photos import by_day, sky_mask, store_photos
from lab.clip_training.small_clip import build_clip, build_tokenizer, load_clip, save_clip
from lab.clip_training.views import COLOR, PART, LandmarkViews
from lang3dxl_ns.common.errors import UserError

LABELS = {
    **{"window": 1, "facade": 2, "vegetation": 3, "street": 4, "car": 5, "balcony-fence": 6, "fence": 7},
    **{"shop": 8, "traffic-infrastructure": 9, "non-building-infrastructure": 10},
}


@pytest.fixture
def folder(tmp_path):
    """Two photos to train with and one to validate: sky, a façade with a window, a street."""
    labels = np.zeros((40, 40), np.uint8)
    labels[15:] = LABELS["facade"]
    labels[20:25, 10:15] = LABELS["window"]
    labels[32:] = LABELS["street"]
    for name in ("train_0", "test_0", "valid_0"):
        for kind, image in (("images", np.full((40, 40, 3), 30, np.uint8)), ("labels", labels)):
            (tmp_path / "data" / kind).mkdir(parents=True, exist_ok=True)
            Image.fromarray(image).save(tmp_path / "data" / kind / f"{name}.png")
    (tmp_path / "data" / "classes.json").write_text(json.dumps({"classes": LABELS}))
    return tmp_path / "data"


def test_photos_are_split_and_their_labels_become_classes(folder, tmp_path):
    train = store_photos(folder, tmp_path / "cache", "train")
    assert len(train) == 2
    assert len(store_photos(folder, tmp_path / "cache", "valid")) == 1
    view = train[0].views[0]
    assert view[PART, 22, 12] == CLASS["window"]
    assert view[PART, 30, 30] == CLASS["facade"]
    assert view[PART, 38, 5] == CLASS["road"]
    assert view[PART, 3, 5] == CLASS["sky"]
    assert train[0].family == -1


def test_the_second_view_is_brighter_and_shows_the_same(folder, tmp_path):
    taken, day = store_photos(folder, tmp_path / "cache", "train")[0].views
    assert (taken[PART:] == day[PART:]).all()
    assert day[COLOR].mean() > taken[COLOR].mean() + 40


def test_a_folder_without_classes_is_an_error(tmp_path):
    with pytest.raises(UserError, match="not a folder of labeled photos"):
        store_photos(tmp_path, tmp_path / "cache", "train")


def test_the_sky_is_what_is_open_above_the_labels_alone():
    classes = np.full((40, 40), CLASS["facade"], np.uint8)
    classes[:10] = UNLABELED
    classes[20:30, 5:15] = UNLABELED  # a hole in the façade
    classes[12, 20] = UNLABELED
    expected = np.zeros((40, 40), bool)
    expected[:10] = True
    np.testing.assert_array_equal(sky_mask(classes), expected)
    classes[:, 7] = UNLABELED  # a column that nobody labeled is not known to be sky
    assert not sky_mask(classes)[:, 7].any()


def test_daylight_keeps_what_is_not_sky_in_order():
    image = np.linspace(5, 60, 40 * 40 * 3).reshape(40, 40, 3).astype(np.uint8)
    sky = np.zeros((40, 40), bool)
    sky[:8] = True
    lit = by_day(image, sky, np.random.default_rng(0)).astype(int)
    below = lit[12:].mean(-1)
    assert (np.diff(below.mean(1)) >= 0).all()
    assert lit[:6].mean() > 100


def crops_of(label, count=8):
    """Crops of a photo that has this label everywhere but for a window."""
    view = np.zeros((6, 80, 80), np.uint8)
    view[PART] = label
    view[PART, 30:50, 30:50] = CLASS["window"]
    return draw_crops([LandmarkViews(0, -1, view[None])], count, 4, 24, np.random.default_rng(0), (60, 80))


def doubts(label):
    captions = [Caption(name, CLASS[name]) for name in ("window", "roof", "portal", "car")]
    captions.append(Caption("stuff", GENERIC))
    crops = crops_of(label)
    shares = label_shares(crops)
    return in_doubt(captions, shares, np.zeros((8, 5))).all(0), in_doubt(
        captions, shares, np.zeros((8, 5))
    ).any(0)


def test_a_facade_may_hide_roofs_and_doors_but_no_car():
    every, some = doubts(CLASS["facade"])
    assert every.tolist() == [False, True, True, False, False]
    assert not some[[0, 3, 4]].any()


def test_a_road_hides_nothing_and_an_unlabeled_crop_everything():
    assert not doubts(CLASS["road"])[1].any()
    assert doubts(UNLABELED)[0].all()


def test_what_is_in_doubt_changes_no_loss():
    images, texts = torch.eye(3), torch.eye(3)
    fit, classes, scale = torch.eye(3), torch.arange(3), torch.tensor(5.0)
    doubt = torch.zeros(3, 3, dtype=torch.bool)
    doubt[0, 1] = True
    turned = torch.nn.functional.normalize(
        images + torch.tensor([[0.0, 1.0, 0.0], [0, 0, 0], [0, 0, 0]]), dim=1
    )
    plain = contrastive_loss(turned, texts, fit, classes, scale)
    open_ = contrastive_loss(turned, texts, fit, classes, scale, doubt)
    assert open_ < plain


def test_unlabeled_pixels_are_of_no_class():
    crops = crops_of(UNLABELED)
    shares = soft_labels(crops)
    assert shares.shape == (8, len(CLASSES))
    np.testing.assert_allclose(shares[:, CLASS["window"]], 1.0)
    assert (main_materials(crops) == -1).all()


def test_crops_of_two_worlds_are_one_batch():
    a, b = crops_of(CLASS["road"], 4), crops_of(CLASS["facade"], 8)
    both = join([a, b])
    assert len(both.images) == len(both.families) == 12
    assert (both.parts[:4] == a.parts).all()
    assert (both.parts[4:] == b.parts).all()


def test_new_layers_change_nothing_at_first(tmp_path):
    tokenizer = build_tokenizer(0)
    clip = build_clip(tokenizer, 0).eval()
    save_clip(clip, tokenizer, tmp_path)
    deeper, _ = load_clip(tmp_path, 6)
    assert len(deeper.vision_model.encoder.layers) == 6
    pixels = torch.rand(2, 3, 48, 48)
    with torch.no_grad():
        expected, found = (m.eval().get_image_features(pixel_values=pixels) for m in (clip, deeper))
    torch.testing.assert_close(found.pooler_output, expected.pooler_output)
