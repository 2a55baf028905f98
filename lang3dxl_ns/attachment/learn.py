"""Learning of a finished splat's codes from photos: prepare, gather, sharpen, compress, without a trainer."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.attachment.known_frames import Similarity
from lang3dxl_ns.components.decoders import DecoderConfig, make_decoder
from lang3dxl_ns.components.feature_decoder import Decoder, LearningDecoder
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.scene.capture import Capture, Split
from lang3dxl_ns.scene.frame import Frame
from lang3dxl_ns.scene.record import SceneRecord
from lang3dxl_ns.training.batches import TrainingData
from lang3dxl_ns.training.learn_codes import learn_codes, target_view

LONGER_SIDE = 800
"""Largest longer side at which photos are gathered, pixels. A fine crop covers dozens of pixels."""


def photos_of(
    capture: Capture,
    similarity: Similarity,
    config: PreparationConfig,
    cache: Path,
    device: torch.device | str,
) -> TrainingData:
    """Return all photos of a capture whose poses are not contradicted, to learn from by `settled` settings,
    with their cameras in the splat's frame, where splat's = similarity · photos'. The folder `cache` keeps
    foreground and targets, where training also finds them."""
    scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
    everything, frame = Split(tuple(capture.sure), ()), Frame(similarity[:3] / scale, scale)
    capture = replace(capture, known_split=everything, known_frame=frame)
    return TrainingData(capture, config, cache, device, targets_in_steps=False)


def learn(splats: Splats, data: TrainingData) -> tuple[Decoder, Float[Tensor, "n code"]]:
    """Learn a decoder and the Gaussians' codes, which are NaN for Gaussians that no photo shows, on the
    splat's device."""
    targets = data.targets
    assert targets is not None
    decoder = make_decoder(DecoderConfig(), SemanticFieldConfig("short"), targets.clip_dim, 0)
    assert isinstance(decoder, LearningDecoder)
    decoder = decoder.to(splats.means.device)
    names = targets.names
    views = (target_view(splats, view.camera(), LONGER_SIDE, batch) for view, batch in data.read(names))
    clip = partial(targets.clip_features, names)
    dense = partial(targets.dense_features, names) if targets.dense_dim else None
    codes = learn_codes(decoder, views, len(names), splats.means, clip, dense)
    return decoder.eval().requires_grad_(False), codes


def scene_file(data: TrainingData) -> SceneRecord:
    """Describe photos, at the size at which they are gathered, and the frame for a scene file."""
    assert data.targets is not None
    record, usable, photos = data.record(), set(data.targets.names), []
    for photo in (photo for photo in record.photos if photo.name in usable):
        size = min(1.0, LONGER_SIDE / max(photo.lens.width, photo.lens.height))
        photos.append(replace(photo, lens=photo.lens.scaled(size)))
    return replace(record, photos=photos)
