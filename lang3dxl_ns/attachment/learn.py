"""Learning of a finished splat's codes from photos: prepare, gather, sharpen, compress, without a trainer."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.attachment.known_frames import Similarity
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.image import resize_nearest
from lang3dxl_ns.components.decoders import DecoderConfig, make_decoder
from lang3dxl_ns.components.feature_decoder import Decoder, LearningDecoder
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.preparation.encoders import CLIP_OPTION, find_model, usual_dense
from lang3dxl_ns.preparation.foreground import with_foreground
from lang3dxl_ns.preparation.model_files import usual_clip
from lang3dxl_ns.preparation.physical_scale import plan_crops
from lang3dxl_ns.preparation.prepare import prepare
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.targets import TargetReader
from lang3dxl_ns.rendering import Splats, composite
from lang3dxl_ns.scene.camera import Camera, camera_to_world, resized
from lang3dxl_ns.scene.capture import Capture
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord
from lang3dxl_ns.training.learn_codes import TargetView, learn_codes

LONGER_SIDE = 800
"""Largest longer side at which photos are gathered, pixels. A fine crop covers dozens of pixels."""


def settled(config: PreparationConfig) -> PreparationConfig:
    """Return the settings for gathering features: fine crops, the CLIP at hand, and its dense encoder."""
    config = replace(config, clip=usual_clip(config.clip))
    return replace(config, dense=usual_dense(config, False), regions="none", crops="fine")


def prepare_photos(
    collection: Capture, config: PreparationConfig, cache: Path, device: torch.device | str
) -> tuple[Capture, TargetReader]:
    """Prepare the photos' foreground and targets with `settled` settings, in the folder `cache`, where
    training also finds them. Photos that cannot be read are left out."""
    photos = [photo.at_most(config.longer_side) for photo in collection.photos]
    masked = with_foreground(photos, config, collection.folder, cache, device, say)
    plan, names = plan_crops(masked, collection.reconstruction, config), [photo.name for photo in masked]
    say(*plan.reasons)
    reader = prepare(masked, plan.pixel_sizes, config, plan.scales, FeatureStore(cache), device, fine=names)
    kept = set(reader.names)
    return replace(collection, photos=[photo for photo in masked if photo.name in kept]), reader


def learn(
    splats: Splats, collection: Capture, cameras: Mapping[str, Camera], targets: TargetReader
) -> tuple[Decoder, Float[Tensor, "n code"]]:
    """Learn a decoder and the Gaussians' codes, which are NaN for Gaussians that no photo shows, on the
    splat's device. `cameras` holds the photos' cameras in the splat's frame."""
    decoder = make_decoder(DecoderConfig(), SemanticFieldConfig("short"), targets.clip_dim, 0)
    assert isinstance(decoder, LearningDecoder)
    decoder = decoder.to(splats.means.device)
    names = [photo.name for photo in collection.photos]
    dense = partial(targets.dense_features, names) if targets.dense_dim else None
    clip, views = partial(targets.clip_features, names), _views(splats, collection.photos, cameras, targets)
    codes = learn_codes(decoder, views, len(names), splats.means, clip, dense)
    return decoder.eval().requires_grad_(False), codes


def _views(
    splats: Splats, photos: Iterable[Photo], cameras: Mapping[str, Camera], targets: TargetReader
) -> Iterator[TargetView]:
    place = splats.means
    for photo in photos:
        camera = resized(cameras[photo.name], LONGER_SIDE)
        dense = targets.dense(photo.name)
        size, mask = (camera.height, camera.width), photo.read_mask()
        yield TargetView(
            partial(composite, splats, camera),
            size,
            targets.clip(photo.name).features.to(place),
            None if dense is None else dense.to(place),
            None if mask is None else resize_nearest(mask, size).to(place.device),
        )


def scene_file(
    collection: Capture, cameras: Mapping[str, Camera], similarity: Similarity, config: PreparationConfig
) -> SceneRecord:
    """Describe what a scene keeps of its photos and of the frame, where splat's = similarity · photos'."""
    known = find_model(config.clip, CLIP_OPTION)
    scale = float(torch.from_numpy(similarity[:3, :3]).double().det().pow(1 / 3))
    photos = []
    for photo in collection.photos:
        pose = camera_to_world(cameras[photo.name].view_matrix.double()).tolist()
        size = min(1.0, LONGER_SIDE / max(photo.width, photo.height))
        photos.append(ScenePhoto.of(photo, "train", pose, size))
    return SceneRecord(
        photos=photos,
        clip=known.address,
        clip_identity=known.clip_identity,
        scale=scale,
        transform=(similarity[:3] / scale).tolist(),
        data=str(collection.folder),
    ).located(collection.photos)
