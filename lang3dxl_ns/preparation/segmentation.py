"""Segmentation networks: CLIPSeg, SAM 3, or GroundingDINO with SAM for prompts; SAM alone without prompts.

All are loaded from a local folder or by Hugging Face name, like the encoders.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.preparation.model_files import (
    ModelFiles,
    find_model,
    load_processor,
    load_weights,
    read_config,
)

TEXT_OPTION = "foreground-model"
SAM_OPTION = "sam"

SAM3_TYPES = ("sam3", "sam3_video")
"""Model types in SAM 3's configuration; published checkpoints contain the detector inside a video model."""
_LEAST_SCORE = 0.5
"""Lowest score of an instance, and of its mask at a pixel."""
_BOX_THRESHOLD = 0.3
"""Minimum confidence of a box (LangSAM's)."""
# These are LangSplat's settings of SAM's automatic masks, published for language fields. Its extra round over
# crops of the photo is omitted: it takes five times as long and finds masks too small for the label maps.
_AUTOMATIC = {
    "points_per_crop": 32,
    "pred_iou_thresh": 0.7,
    "stability_score_thresh": 0.85,
    "crops_nms_thresh": 0.7,
}


class TextSegmenter(Protocol):
    """Network that finds the things that prompts name in an image."""

    def segment(self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]) -> Bool[Tensor, "h w"]:
        """Compute the mask of any of the prompts, at the size of the image, on the CPU."""


@dataclass(frozen=True)
class SegmenterFiles:
    """Local files of a text segmenter's networks."""

    words: ModelFiles
    sam: ModelFiles | None
    """SAM that segments the boxes of a detector; None if `words` makes masks itself."""

    @property
    def identity(self) -> str:
        """Fingerprint of both networks' weights."""
        return self.words.identity if self.sam is None else f"{self.words.identity}+{self.sam.identity}"


def find_text_segmenter(name_or_dir: str, sam: str) -> SegmenterFiles:
    """Find a text segmenter's files: a CLIPSeg or SAM 3 alone, or a GroundingDINO with a SAM. Raises
    UserError if one can't be found or downloaded, or is another kind of model."""
    words = find_model(name_or_dir, TEXT_OPTION)
    kind = read_config(words).model_type
    if kind not in ("clipseg", "grounding-dino", *SAM3_TYPES):
        raise UserError(
            f"{words.name} is a {kind} model: {data_option(TEXT_OPTION)} takes a GroundingDINO "
            "(IDEA-Research/grounding-dino-tiny), a CLIPSeg (CIDAS/clipseg-rd64-refined) or facebook/sam3"
        )
    return SegmenterFiles(words, find_sam(sam) if kind == "grounding-dino" else None)


def find_sam(name_or_dir: str) -> ModelFiles:
    """Find SAM's files. Raises UserError if they are unavailable, or of another kind of model."""
    files = find_model(name_or_dir, SAM_OPTION)
    kind = read_config(files).model_type
    if kind != "sam":
        raise UserError(
            f"{files.name} is a {kind} model: {data_option(SAM_OPTION)} takes a SAM: facebook/sam-vit-base"
        )
    return files


def load_text_segmenter(files: SegmenterFiles, device: torch.device | str) -> TextSegmenter:
    """Load the networks onto `device`. Raises UserError if one is incomplete."""
    if files.sam is not None:
        return BoxesAndSam(files.words, files.sam, device)
    return Sam3(files.words, device) if is_sam3(files) else ClipSeg(files.words, device)


def is_sam3(files: SegmenterFiles) -> bool:
    """Return whether a text segmenter is a SAM 3, which distinguishes instances."""
    return read_config(files.words).model_type in SAM3_TYPES


class ClipSeg:
    """CLIPSeg (Lüddecke and Ecker 2022), which predicts a probability per pixel and prompt."""

    def __init__(self, files: ModelFiles, device: torch.device | str) -> None:
        from transformers import CLIPSegForImageSegmentation, CLIPSegProcessor

        self._model = load_weights(CLIPSegForImageSegmentation, files, device)
        self._processor = load_processor(CLIPSegProcessor, files)
        self._context: int = self._model.config.text_config.max_position_embeddings

    def segment(self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]) -> Bool[Tensor, "h w"]:
        """Threshold the probabilities at 0.5 (see `TextSegmenter.segment`)."""
        return (self.probabilities(image, prompts) >= 0.5).any(dim=0)

    @torch.no_grad()
    def probabilities(self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]) -> Float[Tensor, "q h w"]:
        """Compute every prompt's probability at every pixel, at the image's size, on the CPU."""
        inputs = self._processor(
            text=list(prompts),
            images=[_picture(image)] * len(prompts),
            padding=True,
            truncation=True,
            max_length=self._context,
            return_tensors="pt",
        ).to(self._model.device)
        logits = self._model(**inputs).logits.cpu()
        logits = logits.reshape(len(prompts), 1, *logits.shape[-2:])  # a single prompt comes without an axis
        return F.interpolate(logits, tuple(image.shape[:2]), mode="bilinear")[:, 0].sigmoid()


class Sam3:
    """SAM 3 (Carion et al. 2025), which finds all instances of a text in a picture, with masks and scores. It
    encodes a picture once for all prompts."""

    def __init__(self, files: ModelFiles, device: torch.device | str) -> None:
        from transformers import Sam3Model, Sam3Processor

        self._model = load_weights(Sam3Model, files, device)
        self._processor = load_processor(Sam3Processor, files)

    def segment(self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]) -> Bool[Tensor, "h w"]:
        """Combine the masks of all instances (see `TextSegmenter.segment`)."""
        found = self.instances(image, prompts)
        return torch.cat([masks for masks, _ in found]).any(dim=0)

    def instances(
        self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]
    ) -> list[tuple[Bool[Tensor, "n h w"], Float[Tensor, " n"]]]:
        """Find each prompt's instances: masks at the size of the image, and scores, on the CPU."""
        size, found = tuple(image.shape[:2]), []
        for output in self.outputs(image, prompts):
            (result,) = self._processor.post_process_instance_segmentation(
                output, _LEAST_SCORE, _LEAST_SCORE, target_sizes=[size]
            )
            masks = result["masks"].reshape(-1, *size)  # an empty result has another shape
            found.append((masks.bool().cpu(), result["scores"].float().cpu()))
        return found

    @torch.no_grad()
    def outputs(self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]) -> Iterator[Any]:
        """Yield the network's output for each prompt."""
        device = self._model.device
        pixels = self._processor(images=image.permute(2, 0, 1), return_tensors="pt")["pixel_values"]
        vision = self._model.get_vision_features(pixel_values=pixels.to(device))
        longest = self._model.config.text_config.max_position_embeddings
        for prompt in prompts:
            tokens = self._processor.tokenizer(
                [prompt], padding="max_length", truncation=True, max_length=longest, return_tensors="pt"
            ).to(device)
            yield self._model(
                vision_embeds=vision, input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
            )


class BoxesAndSam:
    """LangSAM: GroundingDINO (Liu et al. 2023) finds boxes, and SAM (Kirillov et al. 2023) segments each."""

    def __init__(self, words: ModelFiles, sam: ModelFiles, device: torch.device | str) -> None:
        from transformers import (
            GroundingDinoForObjectDetection,
            GroundingDinoProcessor,
            SamModel,
            SamProcessor,
        )

        self._detector = load_weights(GroundingDinoForObjectDetection, words, device)
        self._detector_processor = load_processor(GroundingDinoProcessor, words)
        self._sam = load_weights(SamModel, sam, device)
        self._sam_processor = load_processor(SamProcessor, sam)

    def segment(self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]) -> Bool[Tensor, "h w"]:
        """Combine the masks of all boxes (see `TextSegmenter.segment`)."""
        boxes = [self.boxes(image, prompt)[0] for prompt in prompts]
        return self.masks(image, torch.cat(boxes)).any(dim=0)

    @torch.no_grad()
    def masks(self, image: UInt8[Tensor, "h w 3"], boxes: Float[Tensor, "n 4"]) -> Bool[Tensor, "n h w"]:
        """Segment what each box holds, at the size of the image, on the CPU."""
        if not len(boxes):
            return torch.zeros(0, *image.shape[:2], dtype=torch.bool)
        inputs = self._sam_processor(
            images=_picture(image), input_boxes=[boxes.tolist()], return_tensors="pt"
        ).to(self._sam.device, torch.float32)
        output = self._sam(**inputs, multimask_output=False)
        masks = self._sam_processor.post_process_masks(
            output.pred_masks.cpu(),
            inputs["original_sizes"].cpu(),
            reshaped_input_sizes=inputs["reshaped_input_sizes"].cpu(),
        )
        return masks[0][:, 0]

    @torch.no_grad()
    def boxes(
        self, image: UInt8[Tensor, "h w 3"], prompt: str
    ) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
        """Find the boxes of what the prompt names (left, top, right, bottom in pixels), and their scores. The
        detector sees one prompt at a time, so that prompts don't compete."""
        caption = prompt.strip().lower().rstrip(".") + "."  # the form that the detector was trained with
        inputs = self._detector_processor(images=_picture(image), text=caption, return_tensors="pt")
        output = self._detector(**inputs.to(self._detector.device))
        scores = output.logits[0].sigmoid().amax(dim=-1)
        kept = scores >= _BOX_THRESHOLD
        centers, sizes = output.pred_boxes[0][kept].cpu().chunk(2, dim=-1)
        height, width = image.shape[:2]
        corners = torch.cat([centers - sizes / 2, centers + sizes / 2], dim=-1).clamp(0, 1)
        return corners * torch.tensor([width, height, width, height]), scores[kept].cpu()


class AutomaticSam:
    """SAM prompted with a grid of points, which gives overlapping masks of everything."""

    def __init__(self, files: ModelFiles, device: torch.device | str) -> None:
        from transformers import SamModel, SamProcessor, pipeline

        model = load_weights(SamModel, files, device)
        processor = load_processor(SamProcessor, files).image_processor
        self._generate = pipeline("mask-generation", model=model, image_processor=processor, device=device)

    def masks(self, image: UInt8[Tensor, "h w 3"]) -> list[Bool[Tensor, "h w"]]:
        """Find all masks, at the size of the image, on the CPU; empty if there are none."""
        found = self._generate(_picture(image), **_AUTOMATIC)
        return [torch.as_tensor(mask).cpu() for mask in found["masks"]]


def _picture(image: UInt8[Tensor, "h w 3"]) -> Image.Image:
    return Image.fromarray(image.numpy())
