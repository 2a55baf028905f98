"""`attach`: words for a finished splat, learned from its photos or from views of itself."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from lang3dxl_ns.attachment import AttachConfig
from lang3dxl_ns.attachment.frames import find_frame, side_by_side
from lang3dxl_ns.attachment.known_frames import Similarity
from lang3dxl_ns.attachment.learn import learn, photos_of, scene_file
from lang3dxl_ns.attachment.segment import segmented
from lang3dxl_ns.attachment.views import rendered_views
from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.device import known_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded, make_folder
from lang3dxl_ns.common.stages import Stages
from lang3dxl_ns.files.read_splats import find_splats, read_splats
from lang3dxl_ns.files.scene_file import Provenance, check_scene_name, replace_scene
from lang3dxl_ns.files.spz import fractional_bits
from lang3dxl_ns.preparation.model_files import check_encoders
from lang3dxl_ns.preparation.segmentation import find_text_segmenter, load_text_segmenter
from lang3dxl_ns.query.match import save_picture
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import taught_prompt
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.scene.capture import Capture, open_capture
from lang3dxl_ns.scene.companions import cache_folder
from lang3dxl_ns.scene.photo_folder import check_data
from lang3dxl_ns.training.batches import settled

_SMALLEST = 1e-3
"""Size of a splat in its units, below which it lies before the near plane of every camera that shows it."""
_NEAREST = 1.2e-4
"""Size of a splat, relative to its distance from the origin, that 32-bit numbers divide into 1,000 steps."""
_SHARES = {"splat": 0.05, "frame": 0.15, "prepare": 0.5, "learn": 0.3}


def attach(
    splat: str | Path,
    data: str | Path | None = None,
    out: str | Path | None = None,
    config: AttachConfig | None = None,
    device: torch.device | str | None = None,
) -> Scene:
    """Give a finished splat words: make a scene that answers any text, with its Gaussians in the splat's own
    frame and order. Targets are kept beside the photos, so that a repeated call continues an interrupted one.

    Args:
        splat: file or run of the splat, as `read_splats` takes it.
        data: photos of the splat, as `open_capture` takes them. None renders views of the splat, which are
            kept in the hidden folder .NAME.views beside `out`.
        out: scene file to write; None (with `data`): none is written.
        config: settings.
        device: where to compute; by default a GPU if there is one.

    Raises:
        UserError: the splat or the photos cannot be read, or the photos do not show the splat.
    """
    config, place = config or AttachConfig(), None if out is None else expanded(out).absolute()
    _check_request(config, data, place)
    path = find_splats(splat)
    if place is not None:
        make_folder(place.parent)
        if not os.access(place.parent, os.W_OK):
            raise UserError(f"{place.parent} is read-only: choose another place, or change its permissions")
    stages = Stages(_SHARES | {"segment": 0.3} if config.segment else _SHARES)
    worker = known_device(device)
    with stages.stage("splat"):  # a damaged one is refused before any model is downloaded
        splats = _read(path, place).to(worker)
    preparation = settled(config, learned=False, gathered=True)
    check_encoders(preparation.clip, preparation.dense)
    found = find_text_segmenter(preparation.foreground_model, preparation.sam) if config.segment else None
    with stages.stage("frame"):
        if data is None:
            assert place is not None
            folder = place.with_name(f".{place.stem}.views")
            collection, similarity = rendered_views(splats, config.views, config.up, folder), np.eye(4)
        else:
            collection = open_capture(data, cache_dir=config.cache_dir)
            similarity = _frame(splats, collection, path, place)
    with stages.stage("prepare"):
        cache = cache_folder(collection.folder, config.cache_dir)
        prepared = photos_of(collection, similarity, preparation, cache, worker)
        assert prepared.targets is not None
        photos = [prepared.photos[name] for name in prepared.targets.names]
    with stages.stage("learn"):
        decoder, codes = learn(splats, prepared)
    shown = f"{len(photos)} {'views' if data is None else 'photos'}"
    seen = float(codes.isfinite().all(1).float().mean())
    where = " in their foreground" if any(photo.mask_path for photo in photos) else ""
    say(f"{shown} show {seen:.0%} of the Gaussians{where}; the others match nothing")
    file = scene_file(prepared)
    visible = None if place is None else place.with_name(f".{place.stem}.visible")
    scene = Scene(splats, file, decoder, codes, cache=visible)
    if found is not None:
        with stages.stage("segment"):
            segmenter = load_text_segmenter(found, worker)
            cameras = {photo.name: prepared.views[photo.name].camera() for photo in photos}
            for word in config.segment:
                scene = segmented(scene, word, segmenter, photos, cameras)
    if place is not None:
        made = Provenance(title=place.stem, made_how=f"attached to {path.name} from {shown}")
        scene, written = replace_scene(place, scene, made)
        say(f"Wrote {written / 1e6:.1f} MB to {place}")
    if data is None:
        kept = sum(file.stat().st_size for file in collection.folder.rglob("*") if file.is_file())
        say(f"{collection.folder} keeps the views ({kept / 1e6:.0f} MB): delete it if you are done")
    return scene


def _check_request(config: AttachConfig, data: str | Path | None, place: Path | None) -> None:
    """Raise UserError for a word that can't be taught, a name that is no scene's, and missing photos."""
    for word in config.segment:
        taught_prompt(word)
    if place is not None:
        check_scene_name(place)
    elif data is None:
        raise UserError("views of the splat are kept beside its scene: name the file to write (out)")
    if config.clip == "none":
        raise UserError("words come from an image-text encoder: leave --clip none off")
    check_data(None if data is None else Path(data))


def _read(path: Path, place: Path | None) -> Splats:
    """Read and report a splat. Raises UserError if it is damaged, too small or far away to be drawn, or too
    far for the file to write."""
    splats = read_splats(path)
    if place is not None and place.suffix.lower() == ".spz":
        fractional_bits(splats)
    middle = splats.means.median(0).values
    spread, far = float((splats.means - middle).norm(dim=1).median()), float(middle.norm())
    if spread < max(_SMALLEST, _NEAREST * far):
        raise UserError(
            f"half of the Gaussians of {path} lie within {spread:.2g} units of one place, {far:,.0f} "
            "units from the origin, too close to be seen or too far for 32-bit numbers: export the splat "
            "again, larger, or without the offset of map coordinates"
        )
    say(f"{path}: {splats}")
    return splats


def _frame(splats: Splats, collection: Capture, path: Path, place: Path | None) -> Similarity:
    """Find and report the similarity from the photos' frame to the splat's, or raise UserError."""
    reasons = collection.left_out | collection.contradicted
    if reasons:
        named = [f"{name}: {why}" for name, why in reasons.items()]
        say(f"{len(named)} photos are left out: {some(named, 3)}")
    fit, shown = find_frame(splats, collection, path), ""
    if not fit.fits:
        if place is not None:
            picture = place.with_name(f"{place.stem}.frame.png")
            save_picture(side_by_side(splats, collection, fit), picture)
            shown = f"; {picture} shows a photo beside the splat at its camera"
        raise UserError(
            f"the photos in {collection.folder} don't show this splat in any frame that programs use (the "
            f"best, {fit.name}, agrees to {fit.score:.2f} of 1){shown}: give the photos and poses that the "
            "splat was trained with, or leave out --data"
        )
    say(f"the splat's frame is {fit.name}: renderings agree with their photos to {fit.score:.2f} (of 1)")
    return fit.similarity
