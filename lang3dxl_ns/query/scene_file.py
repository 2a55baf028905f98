"""The scene file, NAME.scene: all that rendering and asking a scene need, in one file that can be shared.

It is a safetensors file: no code in it, and every size is checked before a tensor is read. 40 bytes hold a
Gaussian of one color and its code. The metadata entry `lang3dxl` is JSON: format version, photos and cameras,
the CLIP, the decoder's settings, and how the scene was made.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from math import prod
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped, UInt16
from numpy import ndarray as Array
from PIL import Image
from torch import Tensor

from lang3dxl_ns.baselines.decoders import DecoderConfig, make_decoder
from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.device import best_device
from lang3dxl_ns.common.errors import DAMAGE, UserError, in_a_line
from lang3dxl_ns.common.files import expanded, write_atomically
from lang3dxl_ns.components.appearance import AppearanceConfig, AppearanceField
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.looks import Looks
from lang3dxl_ns.components.semantic_field import SemanticFieldConfig
from lang3dxl_ns.query.query_config import QueryConfig
from lang3dxl_ns.query.run_file import SceneFile, scene_from_json
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.splat_file import log_scales, logits
from lang3dxl_ns.query.teach import TaughtWord, words_from_json
from lang3dxl_ns.query.text import EncodeTexts
from lang3dxl_ns.query.vocabulary import common_words
from lang3dxl_ns.rendering.splats import Splats
from lang3dxl_ns.scene.camera import MOST_PIXELS, resized

Module = TypeVar("Module", bound=torch.nn.Module)
SUFFIX = ".scene"
VERSION = 1
_KEY = "lang3dxl"
_MASK_SIDE = 800
"""Longer side of a stored foreground mask in pixels."""
_LARGEST_HALF = 6e4
_UNKNOWN_CODE = 0
"""Stored code of a Gaussian that is visible in no photo; the others are 1 to 65,535."""
_MOST_SETTING = 100_000
"""No setting of a decoder is larger: sizes are refused before anything of that size is built."""


@dataclass(frozen=True)
class Provenance:
    """What a scene file tells about its origin."""

    title: str = ""
    """Heading of the page; by default the name of the photos' folder."""
    credit: str = ""
    """Who took the photos."""
    license: str = ""
    """Terms under which photos and scene may be used."""
    made_by: str = ""
    """Program and version that wrote the file."""
    made_how: str = ""
    """How the scene was made, in a line: the method, its decoder, its iterations."""


# ── writing ─────────────────────────────────────────────────────────────────────────────────────────────


def write_scene(path: Path, scene: Scene, provenance: Provenance | None = None) -> int:
    """Write a scene as one file, atomically.

    Args:
        path: the file; its name ends in .scene.
        scene: the scene. Foreground masks are read from their files and stored with it.
        provenance: what the file tells about its origin.

    Returns:
        The bytes written.

    Raises:
        UserError: the name doesn't end in .scene.
    """
    if path.suffix != SUFFIX:
        raise UserError(f"{path.name} doesn't name a scene: end it in {SUFFIX}")
    from safetensors.numpy import save

    content = _splat_tensors(scene.splats)
    described: dict[str, Any] = {
        "version": VERSION,
        "antialiased": scene.splats.antialiased,
        "background": None if scene.background is None else scene.background.tolist(),
        "provenance": asdict(provenance or Provenance()),
    }
    if scene.decoder is not None and scene.codes is not None:
        described["decoder"] = _described(scene.decoder)
        content["codes"] = _stored_codes(scene.codes, scene.decoder.bounded)
        content |= _stored_state("decoder", scene.decoder)
        described["words"] = list(common_words())
        content["words"] = _array(scene.text.vectors(described["words"]), np.float16)
    if scene.looks is not None:
        field = scene.looks.field
        described["looks"] = {"config": asdict(field.config), "names": field.names}
        content |= _stored_state("looks", field)
    masks = {i: _mask_of(photo) for i, photo in enumerate(scene.photos) if photo.mask is not None}
    content |= {f"mask.{i}": np.frombuffer(mask, np.uint8) for i, mask in masks.items() if mask}
    described["taught"] = [word.to_json() for word in scene.words.values()]
    file = replace(scene.file, photos=[replace(photo, mask=None) for photo in scene.photos])
    described["scene"] = asdict(replace(file, data=Path(file.data).name))
    data = save(content, {_KEY: json.dumps(described, separators=(",", ":"))})
    write_atomically(path, data)
    return len(data)


def keep_words(path: Path, words: Iterable[TaughtWord]) -> None:
    """Replace the taught words in a scene file, atomically; nothing else in it changes.

    Args:
        path: the scene file.
        words: those that it holds from now on.

    Raises:
        UserError: as `read_scene`.
    """
    with _reported(path):
        with _opened(path) as file:
            _description(file)
        content = path.read_bytes()
        begin = 8 + int.from_bytes(content[:8], "little")
        header = json.loads(content[8:begin])
        described = json.loads(header["__metadata__"][_KEY])
        described["taught"] = [word.to_json() for word in words]
        header["__metadata__"][_KEY] = json.dumps(described)
        start = json.dumps(header).encode()
        start += b" " * (-len(start) % 8)  # tensors stay aligned
    write_atomically(path, len(start).to_bytes(8, "little") + start + content[begin:])


def _splat_tensors(splats: Splats) -> dict[str, Shaped[Array, "..."]]:
    return {
        "means": _array(splats.means, np.float32),
        "quats": _array(F.normalize(splats.quats, dim=1), np.float16),
        "log_scales": _array(log_scales(splats), np.float16),
        "logits": _array(logits(splats), np.float16),
        "harmonics": _array(splats.harmonics.clamp(-_LARGEST_HALF, _LARGEST_HALF), np.float16),
    }


def _stored_codes(codes: Float[Tensor, "n d"], bounded: bool) -> Shaped[Array, "n d"]:
    """Bounded codes as 16-bit coordinates in (0, 1), which are what the hash grid reads; others as they
    are."""
    if not bounded:
        return _array(codes, np.float32)
    known = codes.isfinite().all(1, keepdim=True)
    places = 1 + (codes.double().sigmoid() * 65534).round()
    return torch.where(known, places, _UNKNOWN_CODE).cpu().numpy().astype(np.uint16)


def _stored_state(name: str, module: torch.nn.Module) -> dict[str, Shaped[Array, "..."]]:
    tensors = {key: value for key, value in module.state_dict().items() if isinstance(value, Tensor)}
    return {f"{name}.{key}": _smallest(value) for key, value in tensors.items()}


def _smallest(values: Tensor) -> Shaped[Array, "..."]:
    """Weights in half precision, unless they are too large for it, or few."""
    half = values.is_floating_point() and values.numel() > 256 and float(values.abs().max()) < _LARGEST_HALF
    return _array(values, np.float16 if half else values.cpu().numpy().dtype.type)


def _mask_of(photo: Any) -> bytes | None:
    camera = resized(photo.camera, _MASK_SIDE)
    mask = photo.foreground((camera.height, camera.width))
    if mask is None:
        return None
    content = io.BytesIO()
    Image.fromarray(mask.cpu().numpy()).save(content, "PNG", optimize=True)
    return content.getvalue()


def _described(decoder: Decoder) -> dict[str, Any]:
    settings = getattr(getattr(decoder, "field", decoder), "settings", None)
    return {
        "name": decoder.name,
        "clip_dim": decoder.clip_dim,
        "dense_dim": decoder.dense_dim,
        "settings": None if settings is None else asdict(settings),
    }


def _array(tensor: Tensor, kind: Any) -> Shaped[Array, "..."]:
    return tensor.detach().cpu().numpy().astype(kind, order="C")


# ── reading ─────────────────────────────────────────────────────────────────────────────────────────────


def read_scene(
    path: str | Path,
    device: torch.device | str | None = None,
    config: QueryConfig | None = None,
    encode_texts: EncodeTexts | None = None,
) -> Scene:
    """Read a scene file. Nothing in it is executed, and nothing is allocated that the file doesn't hold.

    Args:
        path: the file.
        device: default: a GPU if there is one.
        config: defaults of queries.
        encode_texts: the scene's CLIP, if it is already loaded, or is elsewhere than the scene tells.

    Raises:
        UserError: the file is missing, damaged, cut short, or of a newer version.
    """
    path = expanded(path)
    with _reported(path):
        return _read(path, torch.device(device or best_device()), config, encode_texts)


def describe_scene_file(path: str | Path) -> dict[str, Any]:
    """What a scene file says of itself: `provenance`, `scene`, `gaussians`, `photos`, `clip`, `decoder`,
    `looks`, `taught` (the words taught by example) and `bytes`.

    Raises UserError as `read_scene` does; no tensor is read.
    """
    path = expanded(path)
    with _reported(path), _opened(path) as file:
        described, sizes = _description(file), _sizes(file)
        return {
            "provenance": described.provenance,
            "scene": described.scene,
            "gaussians": sizes["means"][0],
            "photos": len(described.scene.photos),
            "clip": described.scene.clip,
            "decoder": described.decoder,
            "looks": described.looks is not None,
            "taught": described.taught,
            "bytes": path.stat().st_size,
        }


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Errors of reading as one sentence."""
    if not path.is_file():
        raise UserError(f"{path} is not a file: name a {SUFFIX} file")
    try:
        yield
    except _NewerError as error:
        raise UserError(f"{path} has format {error}: a newer lang3dxl-ns wrote it; update yours") from error
    except (UserError, *DAMAGE) as error:
        raise UserError(f"{path} is not a readable scene ({in_a_line(error)}): copy it again") from error


class _NewerError(Exception):
    """The file's format version is unknown."""


@dataclass(frozen=True)
class _Description:
    """The file's metadata, checked."""

    scene: SceneFile
    provenance: Provenance
    antialiased: bool
    background: list[float] | None
    decoder: dict[str, Any] | None
    looks: dict[str, Any] | None
    words: list[str] | None
    taught: list[TaughtWord]


def _read(
    path: Path, device: torch.device, config: QueryConfig | None, encode_texts: EncodeTexts | None
) -> Scene:
    with _opened(path) as file:
        about, sizes = _description(file), _sizes(file)
        splats = _splats(file, sizes, about.antialiased).to(device)
        decoder = codes = looks = None
        if about.decoder is not None:
            decoder = _decoder(file, sizes, about.decoder).to(device)
            codes = _codes(file, sizes, decoder.bounded, len(splats)).to(device)
        if about.looks is not None:
            looks = Looks(_looks(file, sizes, about.looks).to(device))
        vectors = None if about.words is None else _vectors(file, sizes, about.words)
        photos = [
            replace(photo, mask=_checked_mask(file.get_tensor(f"mask.{i}")) if f"mask.{i}" in sizes else None)
            for i, photo in enumerate(about.scene.photos)
        ]
    background = None if about.background is None else torch.tensor(about.background, device=device)
    return Scene(
        splats, replace(about.scene, photos=photos), decoder, codes,
        looks=looks, background=background, config=config, encode_texts=encode_texts,
        vectors=vectors, cache=path.with_name(f".{path.stem}.visible"), words=about.taught,
    )  # fmt: skip


def _opened(path: Path) -> Any:
    from safetensors import SafetensorError, safe_open

    try:
        return safe_open(path, "np")
    except SafetensorError as error:
        raise ValueError(str(error)) from error


def _description(file: Any) -> _Description:
    content = json.loads((file.metadata() or {})[_KEY])
    if content["version"] != VERSION:
        raise _NewerError(content["version"])
    provenance = Provenance(**content["provenance"])
    expect(all(isinstance(text, str) for text in vars(provenance).values()), "its origin is no text")
    background = content["background"]
    if background is not None:
        expect(len(background) == 3 and all(0 <= float(x) <= 1 for x in background), "its background")
    expect(isinstance(content["antialiased"], bool), "antialiased")
    return _Description(
        scene_from_json(content["scene"]),
        provenance,
        content["antialiased"],
        background,
        content.get("decoder"),
        content.get("looks"),
        content.get("words"),
        words_from_json(content.get("taught", [])),
    )


def _sizes(file: Any) -> dict[str, list[int]]:
    return {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118


def _splats(file: Any, sizes: Mapping[str, list[int]], antialiased: bool) -> Splats:
    count, bands = sizes["means"][0], sizes["harmonics"][1]
    expect(bands in (1, 4, 9, 16), f"{bands} harmonics")
    wanted = {"means": [count, 3], "quats": [count, 4], "log_scales": [count, 3]}
    wanted |= {"logits": [count], "harmonics": [count, bands, 3]}
    for name, size in wanted.items():
        expect(sizes[name] == size, f"{name} has the shape {sizes[name]}")
    means, quats, scales, opacities, harmonics = (_tensor(file, name) for name in wanted)
    return Splats(means, quats, scales.exp(), opacities.sigmoid(), harmonics, antialiased)


def _codes(file: Any, sizes: Mapping[str, list[int]], bounded: bool, count: int) -> Float[Tensor, "n d"]:
    expect(len(sizes["codes"]) == 2 and sizes["codes"][0] == count, "its codes")
    stored: UInt16[Array, "n d"] = file.get_tensor("codes")
    if not bounded:
        return torch.from_numpy(stored).float()
    expect(stored.dtype == np.uint16, "its codes")
    places = torch.from_numpy(stored.astype(np.float64))
    codes = ((places - 1) / 65534).clamp(1e-9, 1 - 1e-9).logit().float()
    return torch.where(places == _UNKNOWN_CODE, torch.nan, codes)


def _decoder(file: Any, sizes: Mapping[str, list[int]], told: dict[str, Any]) -> Decoder:
    settings, clip, dense = told["settings"] or {}, told["clip_dim"], told["dense_dim"]
    for value in (clip, dense, *settings.values()):
        expect(isinstance(value, int | float | str), f"a decoder has the setting {value!r}")
        expect(isinstance(value, str) or 0 <= value <= _MOST_SETTING, f"a decoder has the setting {value}")
    stored = sum(prod(size) for name, size in sizes.items() if name.startswith("decoder."))
    expect(
        _parameters(settings, clip + dense) <= 4 * stored + 10_000_000, "its decoder is larger than the file"
    )
    decoder = make_decoder(
        # The first versions called it by the name of the method.
        DecoderConfig(name="gathered" if told["name"] == "lang3dxl" else told["name"]),
        SemanticFieldConfig(preset="short", **settings),
        *(clip, dense, torch.zeros(3), 1.0),
    )
    return _loaded(file, sizes, "decoder", decoder)


def _parameters(settings: Mapping[str, Any], channels: int) -> int:
    """At most how many numbers a decoder with these settings and outputs has."""
    if not settings:
        return 1000 * channels + channels**2
    depth, width = settings["hidden_layers"], settings["hidden_width"]
    expect(
        max(settings["log2_table_size"], settings["levels"], depth) <= 64, "its decoder has too many layers"
    )
    table = settings["levels"] * 2 ** int(settings["log2_table_size"]) * settings["features_per_level"]
    inputs = settings["levels"] * settings["features_per_level"] + channels + 100
    return table + width * (inputs + depth * width + channels)


def _vectors(file: Any, sizes: Mapping[str, list[int]], words: list[str]) -> dict[str, Float[Tensor, " c"]]:
    expect(isinstance(words, list) and all(isinstance(word, str) for word in words), "its words")
    expect(len(sizes["words"]) == 2 and sizes["words"][0] == len(words), "its words")
    return dict(zip(words, F.normalize(_tensor(file, "words"), dim=1), strict=True))


def _looks(file: Any, sizes: Mapping[str, list[int]], told: dict[str, Any]) -> AppearanceField:
    names, config = told["names"], AppearanceConfig(**told["config"])
    expect(isinstance(names, list) and all(isinstance(name, str) for name in names), "its looks' photos")
    expect(sizes["looks.vectors"] == [len(names), config.vector_dim], "its looks")
    field = AppearanceField(config, names, torch.zeros(3), 1.0)
    return _loaded(file, sizes, "looks", field, {"_extra_state": names})


def _loaded(
    file: Any,
    sizes: Mapping[str, list[int]],
    name: str,
    module: Module,
    state: Mapping[str, Any] | None = None,
) -> Module:
    """A module with its tensors from the file, whose shapes must be those that it expects."""
    tensors = {}
    for key, value in module.state_dict().items():
        if isinstance(value, Tensor):
            expect(sizes.get(f"{name}.{key}") == list(value.shape), f"{name}.{key} has the wrong shape")
            tensors[key] = torch.from_numpy(file.get_tensor(f"{name}.{key}"))
    module.load_state_dict({**tensors, **(state or {})})
    return module.eval().requires_grad_(False)


def _checked_mask(stored: Shaped[Array, " b"]) -> bytes:
    content = stored.astype(np.uint8).tobytes()
    with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
        expect(image.width * image.height <= MOST_PIXELS, "a mask is too large")
    return content


def _tensor(file: Any, name: str) -> Float[Tensor, "n ..."]:
    return torch.from_numpy(file.get_tensor(name)).float()
