"""From a run folder to a `Scene`, without a data manager: no photo is opened."""

from __future__ import annotations

import pickle
import time
import zipfile
import zlib
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.trainer import TrainerConfig
from torch import Tensor

from lang3dxl_ns.datamanager import Lang3DXLDataManager
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.geometry import camera_to_world
from lang3dxl_ns.model import Lang3DXLModel
from lang3dxl_ns.preparation.encoders import CLIP_OPTION, find_model, load_image_text_encoder
from lang3dxl_ns.query.scene import QueryConfig, Scene, View
from lang3dxl_ns.query.scene_file import SCENE_FILE, SceneFile, ScenePhoto
from lang3dxl_ns.query.text import EncodeTexts
from lang3dxl_ns.rendering import Camera
from lang3dxl_ns.saved_config import read_config

NO_SEMANTICS = "this run has no semantics (it was trained with clip none): there is nothing to ask it"


def describe_scene(datamanager: Lang3DXLDataManager) -> SceneFile:
    """What a run's folder keeps of its data."""
    outputs, clip = datamanager.train_dataparser_outputs, datamanager.config.clip
    known = None if clip == "none" else find_model(clip, CLIP_OPTION)
    local = Path(clip).expanduser()
    return SceneFile(
        photos=[*_photos(datamanager, "train"), *_photos(datamanager, "eval")],
        clip=None if known is None else str(local.absolute()) if local.is_dir() else clip,
        clip_identity=None if known is None else known.identity,
        scale=float(outputs.dataparser_scale),
        transform=outputs.dataparser_transform.tolist(),
        data=str(Path(datamanager.config.dataparser.data).expanduser().absolute()),
    )


def _photos(datamanager: Lang3DXLDataManager, split: Literal["train", "eval"]) -> list[ScenePhoto]:
    masked = datamanager.photos
    dataset = datamanager.train_dataset if split == "train" else datamanager.eval_dataset
    cameras, photos = dataset.cameras, [masked[photo.name] for photo in dataset.photos]
    return [
        ScenePhoto(
            name=photo.name,
            split=split,
            camera_to_world=cameras.camera_to_worlds[i].tolist(),
            fx=float(cameras.fx[i]),
            fy=float(cameras.fy[i]),
            cx=float(cameras.cx[i]),
            cy=float(cameras.cy[i]),
            width=int(cameras.width[i]),
            height=int(cameras.height[i]),
            mask=None if photo.mask_path is None else str(photo.mask_path.absolute()),
            distortion=list(photo.distortion),
            fisheye=photo.fisheye,
        )
        for i, photo in enumerate(photos)
    ]


def load_scene(
    config: str | Path, device: torch.device | str | None = None, settings: QueryConfig | None = None
) -> Scene:
    """The scene of a run.

    Args:
        config: the run's config.yml. Nothing that stands in it is run (nerfstudio's own commands, ns-eval
            and others, do trust the file). The latest checkpoint beside it is taken.
        device: a GPU where there is one, by default.
        settings: how to answer.

    Raises UserError for a folder without a checkpoint, a run without semantics, a CLIP that is another one
    than the run's.
    """
    path = Path(config).expanduser()
    run = read_config(path)
    file = SceneFile.read(path.parent / SCENE_FILE)
    device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    model = _load_model(run, path.parent, file, device)
    return scene_of_model(model, file, path.parent, settings)


def scene_of_model(
    model: Lang3DXLModel,
    file: SceneFile,
    cache_dir: Path | None = None,
    settings: QueryConfig | None = None,
    guard: Callable[[], AbstractContextManager] = nullcontext,
    encode_texts: EncodeTexts | None = None,
    watch: Callable[[str], None] | None = None,
) -> Scene:
    """A scene around a model that is loaded, be it still in training (then without `cache_dir`).

    Args:
        guard: entered around every use of the model, which other threads may be using.
        encode_texts: the run's CLIP, where it is loaded already (`text_encoder`).
        watch: see `Scene`.

    Raises UserError where the model has no semantics, or its CLIP has changed.
    """
    field = model.semantic_field
    encode_texts = encode_texts or text_encoder(file, model.device)
    if field is None:
        raise UserError(NO_SEMANTICS)
    render = renderer(model)

    def guarded_render(camera: Camera) -> View:
        with guard():
            return render(camera)

    def guarded_decode(codes: Float[Tensor, "n code"]) -> Float[Tensor, "n c"]:
        with guard():
            return field.decode_clip(codes)

    gaussians = {name: parameter.detach() for name, parameter in model.gauss_params.items()}
    with torch.no_grad():
        carried = field.carried(gaussians)
    return Scene(
        render=guarded_render,
        decode=guarded_decode,
        bounded=field.bounded,
        gaussians=gaussians if carried is None else gaussians | {"codes": carried},
        file=file,
        encode_texts=encode_texts,
        state=model.state_dict(),
        cache_dir=cache_dir,
        config=settings,
        watch=watch,
    )


def text_encoder(file: SceneFile, device: torch.device | str) -> EncodeTexts:
    """The CLIP that a run learned from. Raises UserError where there is none, or it has changed."""
    if file.clip is None:
        raise UserError(NO_SEMANTICS)
    encoder = load_image_text_encoder(file.clip, device)
    if encoder.identity != file.clip_identity:
        raise UserError(
            f"the CLIP in {file.clip} is not the one that this run learned from: restore it, or train anew"
        )
    return encoder.encode_texts


def _load_model(run: TrainerConfig, folder: Path, file: SceneFile, device: torch.device) -> Lang3DXLModel:
    checkpoints = sorted((folder / run.relative_model_dir).glob("step-*.ckpt"))
    if not checkpoints:
        raise UserError(
            f"{folder / run.relative_model_dir} holds no checkpoint: train for longer, or copy it"
        )
    check_checkpoint(checkpoints[-1])
    try:
        state = torch.load(checkpoints[-1], map_location="cpu", weights_only=True)["pipeline"]
    except (RuntimeError, pickle.UnpicklingError, LookupError, TypeError) as error:
        raise UserError(
            f"{checkpoints[-1]} is not a checkpoint of lang3dxl ({error}): nothing in it was run; pass a run "
            "whose origin you know"
        ) from error
    photos = [photo for photo in file.photos if photo.split == "train"]
    # The checkpoint brings its own Gaussians: start from the fewest that there can be.
    start = replace(run.pipeline.model, sky_gaussians=0, random_init=False)  # type: ignore[call-arg]
    model = start.setup(
        scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])),
        num_train_data=len(photos),
        metadata={"feature_statistics": None, "photos": photos},
        device=device,
        grad_scaler=None,
        seed_points=(torch.eye(4)[:, :3], torch.zeros(4, 3)),
    )
    assert isinstance(model, Lang3DXLModel)
    model.load_state_dict({k.removeprefix("_model."): v for k, v in state.items() if k.startswith("_model.")})
    return model.to(device).eval()


def check_checkpoint(place: Path) -> None:
    """Read the checkpoint at a path, or the latest in a folder, against its checksums.

    Raises UserError where it is damaged. Nothing is said about a folder without any: a run begins so.
    """
    checkpoints = sorted(place.glob("step-*.ckpt")) if place.is_dir() else [place]
    if not checkpoints or not checkpoints[-1].is_file():
        return
    try:
        with zipfile.ZipFile(checkpoints[-1]) as archive:
            damaged = archive.testzip()
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, NotImplementedError, zlib.error):
        damaged = "the whole file"
    if damaged is not None:
        raise UserError(
            f"the checkpoint {checkpoints[-1]} is damaged ({damaged}), perhaps by an incomplete copy: copy "
            "it again, move it away to go on from an earlier one, or train anew (prepared targets are kept)"
        )


def renderer(model: Lang3DXLModel) -> Callable[[Camera], View]:
    """Draws cameras of the rasteriser with a model in evaluation."""

    def render(camera: Camera) -> View:
        start = time.perf_counter()
        model.set_crop(None)
        outputs = model.get_outputs(as_nerfstudio(camera).to(model.device))
        maps = {name: outputs[name][..., 0] for name in ("accumulation", "depth")}
        return View(
            camera,
            outputs["rgb"],
            model.rendered_codes,
            maps["accumulation"],
            maps["depth"],
            time.perf_counter() - start,
        )

    return render


def as_nerfstudio(camera: Camera) -> Cameras:
    """The same camera as nerfstudio's."""
    k: Float[Tensor, "3 3"] = camera.intrinsics.cpu()
    return Cameras(
        camera_to_worlds=camera_to_world(camera.view_matrix.cpu())[None],
        fx=float(k[0, 0]),
        fy=float(k[1, 1]),
        cx=float(k[0, 2]),
        cy=float(k[1, 2]),
        width=camera.width,
        height=camera.height,
    )
