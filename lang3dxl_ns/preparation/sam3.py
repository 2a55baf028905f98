"""SAM 3 (Carion et al. 2025), which finds all instances of a text in a picture, with masks and scores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lang3dxl_ns.preparation.model_files import ModelFiles, load_processor, load_weights

MODEL_TYPES = ("sam3", "sam3_video")
"""Model types in SAM 3's configuration; published checkpoints contain the detector inside a video model."""
_LEAST_SCORE = 0.5
"""Lowest score of an instance, and of its mask at a pixel."""


class Sam3:
    """Text segmenter that encodes a picture once for all prompts."""

    def __init__(self, files: ModelFiles, device: torch.device | str) -> None:
        from transformers import Sam3Model, Sam3Processor

        self._model = load_weights(Sam3Model, files, device)
        self._processor = load_processor(Sam3Processor, files)

    def segment(self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]) -> Bool[Tensor, "h w"]:
        """Combine the masks of all instances (see `TextSegmenter.segment`)."""
        found = self.instances(image, prompts)
        return torch.cat([masks for masks, _ in found]).any(dim=0)

    def probabilities(self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]) -> Float[Tensor, "q h w"]:
        """Compute, for each prompt and pixel, the highest instance score × mask, without a threshold."""
        maps = []
        for output in self._outputs(image, prompts):
            scores = (output.pred_logits.sigmoid() * output.presence_logits.sigmoid())[0]
            maps.append((scores[:, None, None] * output.pred_masks[0].sigmoid()).amax(dim=0))
        size = tuple(image.shape[:2])
        return F.interpolate(torch.stack(maps)[None].float(), size, mode="bilinear")[0].cpu()

    def instances(
        self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]
    ) -> list[tuple[Bool[Tensor, "n h w"], Float[Tensor, " n"]]]:
        """Find each prompt's instances: masks at the size of the image, and scores, on the CPU."""
        size, found = tuple(image.shape[:2]), []
        for output in self._outputs(image, prompts):
            (result,) = self._processor.post_process_instance_segmentation(
                output, _LEAST_SCORE, _LEAST_SCORE, target_sizes=[size]
            )
            masks = result["masks"].reshape(-1, *size)  # an empty result has another shape
            found.append((masks.bool().cpu(), result["scores"].float().cpu()))
        return found

    @torch.no_grad()
    def _outputs(self, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]) -> Iterator[Any]:
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
