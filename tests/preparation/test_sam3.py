"""SAM 3 on a small model of its real layout, against transformers' own post-processing."""

from __future__ import annotations

from types import MappingProxyType

import pytest
import torch
import torch.nn.functional as F
from tiny_models import make_tiny_clipseg
from tiny_teachers import make_tiny_sam3

from lab.benchmarks.scored_runs import probabilities
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation import segmentation
from lang3dxl_ns.preparation.regions import MaskRegions, region_source
from lang3dxl_ns.preparation.segmentation import Sam3, find_text_segmenter, is_sam3, load_text_segmenter
from lang3dxl_ns.preparation.settings import PreparationConfig

IMAGE = torch.randint(0, 256, (60, 90, 3), dtype=torch.uint8, generator=torch.manual_seed(0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return str(make_tiny_sam3(tmp_path_factory.mktemp("models") / "sam3"))


@pytest.fixture(scope="module")
def segmenter(folder):
    return load_text_segmenter(find_text_segmenter(folder, "no/such-sam"), "cpu")


@pytest.fixture
def lenient(monkeypatch):
    """A random network's scores are all low."""
    monkeypatch.setattr(segmentation, "_LEAST_SCORE", 0.2)


@torch.no_grad()
def own_output(folder, prompt):
    from transformers import Sam3Model, Sam3Processor

    model, processor = Sam3Model.from_pretrained(folder), Sam3Processor.from_pretrained(folder)
    inputs = processor(images=IMAGE.permute(2, 0, 1), text=prompt, return_tensors="pt")
    inputs.pop("original_sizes")
    return processor, model.eval()(**inputs)


def test_the_published_layout_is_recognized_and_complete(segmenter, folder):
    assert isinstance(segmenter, Sam3) and is_sam3(find_text_segmenter(folder, ""))


def test_instances_are_transformers_own(segmenter, folder, lenient):
    processor, output = own_output(folder, "tower")
    (expected,) = processor.post_process_instance_segmentation(output, 0.2, 0.2, target_sizes=[(60, 90)])
    ((masks, scores),) = segmenter.instances(IMAGE, ["tower"])
    assert len(scores) > 1 and masks.any()
    torch.testing.assert_close(scores, expected["scores"])
    assert (masks == expected["masks"].bool()).double().mean() > 0.999


def test_a_pixel_has_the_best_instances_score_times_its_mask(segmenter, folder):
    _, output = own_output(folder, "tower")
    masks = F.interpolate(output.pred_masks.sigmoid(), (60, 90), mode="bilinear")[0]
    scores = (output.pred_logits.sigmoid() * output.presence_logits.sigmoid())[0]
    (found,) = probabilities(segmenter, IMAGE, ["tower"])
    assert found.shape == (60, 90) and found.min() >= 0 and found.max() <= 1
    torch.testing.assert_close(found, (scores[:, None, None] * masks).amax(0), rtol=0, atol=2e-2)


def test_prompts_share_a_picture_and_do_not_compete(segmenter, lenient):
    both = probabilities(segmenter, IMAGE, ["tower", "sky"])
    for prompt, one in zip(["tower", "sky"], both, strict=True):
        torch.testing.assert_close(probabilities(segmenter, IMAGE, [prompt])[0], one)
    union = segmenter.segment(IMAGE, ["tower", "sky"])
    assert torch.equal(union, segmenter.segment(IMAGE, ["tower"]) | segmenter.segment(IMAGE, ["sky"]))


def test_nothing_found_is_an_empty_mask(segmenter, monkeypatch):
    monkeypatch.setattr(segmentation, "_LEAST_SCORE", 1.0)
    assert segmenter.segment(IMAGE, ["tower", "sky"]).shape == (60, 90)
    assert not segmenter.segment(IMAGE, ["tower"]).any()


def test_regions_are_instances_of_what_the_prompts_name(folder, monkeypatch):
    config = PreparationConfig(regions="text", foreground_model=folder, region_prompts=("tower", "sky"))
    source = region_source(config, None)
    assert isinstance(source, MaskRegions)
    masks = torch.zeros(3, 60, 90, dtype=torch.bool)
    masks[0, :20], masks[1, 40:, :30], masks[2, 40:, 60:] = True, True, True
    found = {"sky": masks[:1], "tower": masks[1:]}
    monkeypatch.setattr(
        Sam3, "instances", lambda _, image, prompts: [(found[p], torch.ones(len(found[p]))) for p in prompts]
    )
    labels = source.labels(None, IMAGE / 255)
    assert (labels[~masks.any(0)] == -1).all()
    assert all(len(labels[mask].unique()) == 1 for mask in masks) and len(labels.unique()) == 4
    assert source.settings(None)["prompts"] == ["sky", "tower"]
    monkeypatch.setattr(Sam3, "instances", lambda *_: [(masks[:0], torch.zeros(0))])
    assert (source.labels(None, IMAGE / 255) == -1).all()


def test_regions_by_text_need_a_network_that_tells_instances_apart(tmp_path):
    light = str(make_tiny_clipseg(tmp_path / "clipseg"))
    with pytest.raises(UserError, match="needs a SAM 3"):
        region_source(PreparationConfig(regions="text", foreground_model=light), None)


def test_a_gated_model_names_the_way_in(monkeypatch):
    import huggingface_hub
    from huggingface_hub.errors import GatedRepoError

    def gated(*_, **__):
        raise GatedRepoError("401", response=_Response())

    monkeypatch.setattr(huggingface_hub, "snapshot_download", gated)
    with pytest.raises(UserError, match=r"gated: accept its license at .*facebook/sam3.*hf auth login"):
        find_text_segmenter("facebook/sam3", "")


class _Response:
    headers = MappingProxyType({})
    request = None
