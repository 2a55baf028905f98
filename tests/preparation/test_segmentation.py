"""Segmentation networks, on saved folders of tiny random models."""

from __future__ import annotations

import shutil

import pytest
import torch
from tiny_models import make_tiny_clipseg, make_tiny_dinov2, make_tiny_grounding_dino, make_tiny_sam

from lab.benchmarks.scored_runs import probabilities
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation import segmentation
from lang3dxl_ns.preparation.segmentation import (
    AutomaticSam,
    BoxesAndSam,
    ClipSeg,
    find_sam,
    find_text_segmenter,
    load_text_segmenter,
)

IMAGE = torch.randint(0, 256, (60, 90, 3), dtype=torch.uint8, generator=torch.manual_seed(0))


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return {
        "clipseg": str(make_tiny_clipseg(folder / "clipseg")),
        "grounding": str(make_tiny_grounding_dino(folder / "grounding", seed=2)),
        "sam": str(make_tiny_sam(folder / "sam", seed=2)),
        "dinov2": str(make_tiny_dinov2(folder / "dinov2")),
    }


@pytest.fixture(scope="module", params=["clipseg", "grounding"])
def segmenter(request, models):
    return load_text_segmenter(find_text_segmenter(models[request.param], models["sam"]), "cpu")


def test_several_prompts_give_the_union_of_their_masks(segmenter):
    tower, sky, both = (
        segmenter.segment(IMAGE, prompts) for prompts in (["tower"], ["sky"], ["tower", "sky"])
    )
    assert both.shape == (60, 90)
    assert both.dtype == torch.bool
    assert 0 < tower.float().mean() < 1
    assert not torch.equal(tower, sky)
    assert torch.equal(both, tower | sky)


def test_the_kind_of_model_decides(models):
    light = find_text_segmenter(models["clipseg"], "no/such-sam")  # needs no SAM
    full = find_text_segmenter(models["grounding"], models["sam"])
    assert isinstance(load_text_segmenter(light, "cpu"), ClipSeg)
    assert isinstance(load_text_segmenter(full, "cpu"), BoxesAndSam)
    assert light.identity != full.identity


def test_clipsegs_mask_is_where_its_probability_is_a_half(models):
    from transformers import CLIPSegForImageSegmentation, CLIPSegProcessor

    image = torch.nn.functional.interpolate(IMAGE.permute(2, 0, 1)[None].float(), (32, 32))[0].byte()
    inputs = CLIPSegProcessor.from_pretrained(models["clipseg"])(
        text=["tower"], images=[image], return_tensors="pt"
    )
    with torch.no_grad():
        logits = CLIPSegForImageSegmentation.from_pretrained(models["clipseg"])(**inputs).logits
    clipseg = load_text_segmenter(find_text_segmenter(models["clipseg"], ""), "cpu")
    mask = clipseg.segment(image.permute(1, 2, 0), ["tower"])
    assert torch.equal(mask, logits.reshape(32, 32).sigmoid() >= 0.5)
    (probability,) = clipseg.probabilities(image.permute(1, 2, 0), ["tower"])
    torch.testing.assert_close(probability, logits.reshape(32, 32).sigmoid())


def test_boxes_are_those_of_transformers_own_postprocessing(models):
    from transformers import GroundingDinoForObjectDetection, GroundingDinoProcessor

    processor = GroundingDinoProcessor.from_pretrained(models["grounding"])
    inputs = processor(images=IMAGE.permute(2, 0, 1), text="tower.", return_tensors="pt")
    with torch.no_grad():
        output = GroundingDinoForObjectDetection.from_pretrained(models["grounding"])(**inputs)
    (expected,) = processor.post_process_grounded_object_detection(
        output, inputs.input_ids, threshold=0.3, target_sizes=[(60, 90)]
    )
    found = load_text_segmenter(find_text_segmenter(models["grounding"], models["sam"]), "cpu")
    boxes, scores = found.boxes(IMAGE, " Tower. ")
    largest = torch.tensor([90.0, 60.0, 90.0, 60.0])
    torch.testing.assert_close(boxes, expected["boxes"].clamp(min=0).minimum(largest), rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(scores, expected["scores"], rtol=1e-4, atol=1e-5)
    assert len(boxes) > 1


def test_one_box_and_no_box_give_a_mask_too(models, monkeypatch):
    found = load_text_segmenter(find_text_segmenter(models["grounding"], models["sam"]), "cpu")
    monkeypatch.setattr(found, "boxes", lambda *_: (torch.tensor([[10.0, 10.0, 40.0, 50.0]]), torch.ones(1)))
    assert found.segment(IMAGE, ["tower"]).shape == (60, 90)
    monkeypatch.setattr(found, "boxes", lambda *_: (torch.zeros(0, 4), torch.zeros(0)))
    assert not found.segment(IMAGE, ["tower", "sky"]).any()


def test_a_pixel_has_the_score_of_the_best_box_whose_mask_covers_it(models, monkeypatch):
    found = load_text_segmenter(find_text_segmenter(models["grounding"], models["sam"]), "cpu")
    scores = {"tower": torch.tensor([0.4, 0.9, 0.5]), "sky": torch.zeros(0), "dome": torch.tensor([0.7])}
    monkeypatch.setattr(
        found, "boxes", lambda _, prompt: (torch.zeros(len(scores[prompt]), 4), scores[prompt])
    )
    masks = torch.zeros(4, 60, 90, dtype=torch.bool)
    masks[0, :30], masks[1, 10:20], masks[2, 25:40], masks[3, :, :5] = True, True, True, True
    by_number = {3: masks[:3], 0: masks[:0], 1: masks[3:]}
    monkeypatch.setattr(found, "masks", lambda _, boxes: by_number[len(boxes)])
    tower, sky, dome = probabilities(found, IMAGE, list(scores))
    assert tower[[0, 15, 27, 35, 50], 0].tolist() == pytest.approx([0.4, 0.9, 0.5, 0.5, 0])
    assert not sky.any() and torch.equal(dome, 0.7 * masks[3])


def test_automatic_masks_cover_the_image_at_its_own_size(models, monkeypatch):
    for setting, value in {
        "points_per_crop": 3,
        "pred_iou_thresh": -1e9,  # a random network's masks all score badly
        "stability_score_thresh": -1,
        "crops_nms_thresh": 1.0,
    }.items():
        monkeypatch.setitem(segmentation._AUTOMATIC, setting, value)
    sam = AutomaticSam(find_sam(models["sam"]), "cpu")
    masks = sam.masks(IMAGE)
    assert len(masks) > 1
    assert {(mask.shape, mask.dtype) for mask in masks} == {((60, 90), torch.bool)}
    monkeypatch.setitem(segmentation._AUTOMATIC, "pred_iou_thresh", 1e9)
    assert sam.masks(IMAGE) == []


def test_models_of_another_kind_are_refused_with_the_option_to_change(models):
    with pytest.raises(UserError, match=r"dinov2 model.*foreground-model"):
        find_text_segmenter(models["dinov2"], models["sam"])
    with pytest.raises(UserError, match=r"clipseg model.*--sam"):
        find_text_segmenter(models["grounding"], models["clipseg"])


def test_no_segmentation_network_is_built_in(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"builtin.*--sam"):
        find_sam("builtin")


def test_offline_the_error_says_how_to_get_the_model(models):
    with pytest.raises(
        UserError, match=r"hf download IDEA-Research/grounding-dino-tiny .*foreground-model DIR"
    ):
        find_text_segmenter("IDEA-Research/grounding-dino-tiny", models["sam"])
    with pytest.raises(UserError, match=r"hf download facebook/sam-vit-base .*--sam DIR"):
        find_text_segmenter(models["grounding"], "facebook/sam-vit-base")


def test_missing_processor_files_are_named(models, tmp_path):
    folder = shutil.copytree(models["sam"], tmp_path / "sam")
    (folder / "processor_config.json").unlink()
    with pytest.raises(UserError, match=r"lacks files.*preprocessor_config\.json"):
        AutomaticSam(find_sam(str(folder)), "cpu")
