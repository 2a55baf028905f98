"""The scene file, NAME.scene: everything needed to render and query a scene, in one file that can be shared.

It is a safetensors file: it contains no code, and every size is checked before a tensor is read. A Gaussian
of one color with its code takes 40 bytes. The metadata entry `lang3dxl` is JSON: format version, photos and
cameras, the CLIP, the decoder's settings, and how the scene was made.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from numpy import ndarray as Array
from PIL import Image
from torch import Tensor

from lang3dxl_ns import __version__
from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.device import known_device
from lang3dxl_ns.common.errors import DAMAGE, UserError, in_a_line, not_of_memory
from lang3dxl_ns.common.files import expanded, file_locked, set_aside, slugs, write_atomically
from lang3dxl_ns.components.appearance import HIDDEN, AppearanceConfig, AppearanceField
from lang3dxl_ns.components.decoders import DecoderConfig, make_decoder
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.files import glb, spz
from lang3dxl_ns.files.activations import log_scales, logits
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import EncodeTexts
from lang3dxl_ns.query.vocabulary import common_words
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.scene.camera import MOST_PIXELS, resized
from lang3dxl_ns.scene.record import SceneRecord, same_clip, scene_from_json
from lang3dxl_ns.words.taught_words import TaughtWord, known_word, save_words, words_from_json

Module = TypeVar("Module", bound=torch.nn.Module)
SUFFIX = ".scene"
_CARRIERS = {".glb": glb.scene_record, ".spz": spz.scene_record}
"""Readers of the scene file that a splat file can carry."""
VERSION = 1
_KEY = "lang3dxl"
_MASK_SIDE = 800
"""Longer side of a stored foreground mask in pixels."""
_LARGEST_HALF = 6e4
_STEPS = 65534
"""Steps of stored codes, which are 1 to 65,535, and 0 for a Gaussian that is visible in no photo."""
_MOST_SETTING = 100_000
"""Upper limit of a decoder's settings: larger sizes are refused before anything of that size is built."""


@dataclass(frozen=True)
class Provenance:
    """Origin of a scene, as its file describes it."""

    title: str = ""
    """Heading of the page; default: the name of the photos' folder."""
    credit: str = ""
    """Authors of the photos."""
    license: str = ""
    """Terms under which photos and scene may be used."""
    made_by: str = f"lang3dxl-ns {__version__}"
    """Program and version that wrote the file."""
    made_how: str = ""
    """How the scene was made, in one line: the method, its decoder and its iterations."""
    tour: str = ""
    """Stops of a tour, as the page's link holds them."""


# ── writing ─────────────────────────────────────────────────────────────────────────────────────────────


def check_scene_name(path: Path) -> None:
    """Raise UserError if the path is a folder, or its name ends in none of .scene, .glb and .spz."""
    if path.is_dir():
        raise UserError(f"{path} is a folder: name a {SUFFIX} file in it")
    if path.suffix != SUFFIX and path.suffix.lower() not in _CARRIERS:
        raise UserError(f"{path.name} must have the extension {SUFFIX}, {' or '.join(_CARRIERS)}")


def write_scene(path: Path, scene: Scene, provenance: Provenance | None = None) -> int:
    """Write a scene as one file, atomically, with foreground masks read from their files. Return the number
    of bytes. A .glb or .spz is the scene's splats, which viewers show, with its file inside.
    Raises UserError as `check_scene_name`."""
    check_scene_name(path)
    from safetensors.numpy import save

    content = _stored_splats(scene.splats)
    described: dict[str, Any] = {
        "version": VERSION,
        "antialiased": scene.splats.antialiased,
        "background": None if scene.background is None else scene.background.tolist(),
        "provenance": asdict(provenance or Provenance()),
        "taught": [word.to_json() for word in scene.words.values()],
    }
    if scene.decoder is not None and scene.codes is not None:
        words = list(common_words())
        described |= {"decoder": _described_decoder(scene.decoder), "words": words}
        content |= _stored_state("decoder", scene.decoder)
        content["codes"] = _stored_codes(scene.codes, scene.decoder.bounded)
        content["words"] = _array(scene.text.vectors(words), np.float16)
    if scene.looks is not None:
        described["looks"] = {"config": asdict(scene.looks.config), "names": scene.looks.names}
        content |= _stored_state("looks", scene.looks)
    content |= _stored_masks(scene)
    photos = [replace(photo, mask=None) for photo in scene.photos]
    described["scene"] = asdict(replace(scene.file, photos=photos, data=Path(scene.file.data).name))
    data = save(content, {_KEY: json.dumps(described, separators=(",", ":"))})
    if (kind := path.suffix.lower()) in _CARRIERS:
        data = _carried(kind, scene, data)
    write_atomically(path, data)
    return len(data)


def _stored_splats(splats: Splats) -> dict[str, Array]:
    return {
        "means": _array(splats.means, np.float32),
        "quats": _array(F.normalize(splats.quats, dim=1), np.float16),
        "log_scales": _array(log_scales(splats), np.float16),
        "logits": _array(logits(splats), np.float16),
        "harmonics": _array(splats.harmonics.clamp(-_LARGEST_HALF, _LARGEST_HALF), np.float16),
    }


def _described_decoder(decoder: Decoder) -> dict[str, Any]:
    values = {} if decoder.settings is None else asdict(decoder.settings)
    values.pop("preset", None)  # all of its values are there
    described = {"name": decoder.name, "clip_dim": decoder.clip_dim, "dense_dim": decoder.dense_dim}
    return described | {"settings": values or None}


def _stored_codes(codes: Float[Tensor, "n d"], bounded: bool) -> Array:
    """Encode codes as they are, or bounded ones as 16-bit coordinates in (0, 1), which the hash grid reads,
    with 0 for Gaussians without one."""
    if not bounded:
        return _array(codes, np.float32)
    places = 1 + (codes.double().sigmoid() * _STEPS).round()
    return _array(torch.where(codes.isfinite().all(1, keepdim=True), places, 0), np.uint16)


def _stored_masks(scene: Scene) -> dict[str, Array]:
    """Encode the photos' foreground masks as PNG, at a size that suffices for queries."""
    stored = {}
    for i, photo in enumerate(scene.photos):
        camera, picture = resized(photo.camera, _MASK_SIDE), io.BytesIO()
        if (mask := photo.foreground((camera.height, camera.width))) is not None:
            Image.fromarray(mask.cpu().numpy()).save(picture, "PNG", optimize=True)
            stored[f"mask.{i}"] = np.frombuffer(picture.getvalue(), np.uint8)
    return stored


def _carried(kind: str, scene: Scene, record: bytes) -> bytes:
    """Encode a scene's splats with its file inside."""
    splats = scene.baked()
    if kind == ".spz":
        return spz.encode_spz(splats.select(splats.sound()), record)
    codes = scene.codes
    if codes is not None:
        bounded = scene.decoder is not None and scene.decoder.bounded
        codes = (codes.sigmoid() if bounded else codes).nan_to_num()
    return glb.encode_glb(splats, record, codes, place=scene.file.georeference)


def keep_words(path: Path, words: Mapping[str, TaughtWord | None], tour: str | None = None) -> None:
    """Replace some of a scene file's taught words (None: forget it) and its tour, if one is given, and
    nothing else, atomically. Words that another command taught meanwhile stay. Raises UserError as
    `read_scene`."""
    from safetensors.numpy import save

    if path.suffix.lower() in _CARRIERS:
        raise UserError(
            f"{path} can't be changed: write a scene, lang3dxl export {path} --scene-file NAME{SUFFIX}"
        )
    with _opened(path) as file:
        kept = {**{known_word(word.name): word for word in file.taught}, **words}
        described = file.about | {"taught": [word.to_json() for word in kept.values() if word is not None]}
        described["provenance"] |= {} if tour is None else {"tour": tour}
        content = {name: file.array(name) for name in file.shapes}
    write_atomically(path, save(content, {_KEY: json.dumps(described)}))


def replace_scene(path: Path, scene: Scene, told: Provenance, *earlier: Path) -> tuple[Scene, int]:
    """Write a scene over the file that it replaces, as `write_scene`, with the words taught there and in
    `earlier` files, and with its credit, license and tour unless others are told. Return the written
    scene and the number of bytes. A command that teaches there at this moment comes first, or waits."""
    with file_locked(path):
        if path.is_file():
            try:
                old = describe_scene_file(path)["provenance"]
                kept = {
                    name: getattr(told, name) or getattr(old, name) for name in ("credit", "license", "tour")
                }
                told = replace(told, **kept)
            except UserError as error:  # a newer format, a cut copy, or no scene at all
                say(f"{error}. The file is kept as {set_aside(path)}")
        for file in (path, *earlier):
            scene = _with_words_of(scene, file, path)
        return scene, write_scene(path, scene, told)


def _with_words_of(scene: Scene, earlier: Path, replaced: Path) -> Scene:
    """Return the scene with a file's taught words, where it doesn't know them. Log which are kept and how,
    and which are lost. A missing file has no words. Words of the `replaced` file that are lost, or that the
    scene knows from other examples, are saved beside it. In a scene that has a CLIP but no words yet, since
    its training goes on, they wait as they are."""
    if not earlier.is_file():
        return scene
    try:
        words = describe_scene_file(earlier)["taught"]
    except UserError as error:
        say(f"Words taught in {earlier.name} are not carried over: {error}")
        return scene
    for word in words:
        name, new = known_word(word.name), scene.words.get(known_word(word.name))
        if new is not None:
            if earlier == replaced and new.lacks_examples_of(word):
                say(f"The taught word {word.name!r} is replaced; {_kept_beside(earlier, word)}")
            continue
        if scene.decoder is None and scene.file.clip is not None:
            scene = scene.with_words([*scene.words.values(), word])
            continue
        try:
            scene = scene.carrying(word)
        except UserError as error:
            kept = f"; {_kept_beside(earlier, word)}" if earlier == replaced else ""
            say(f"The taught word {word.name!r} is lost: {error}{kept}")
            continue
        count, all_ = len(scene.words[name].examples), len(word.examples)
        how = f"learned anew from its examples ({count})" if count else "as it was: check it in a few photos"
        how += f"; the photos of {all_ - count} others are not those of before" if 0 < count < all_ else ""
        say(f"The taught word {word.name!r} is kept, {how}")
    return scene


def _kept_beside(scene: Path, word: TaughtWord) -> str:
    """Save a word with its examples beside its scene's file, and say where."""
    backup = scene.with_name(f"{scene.stem}.{slugs([known_word(word.name)])[0]}.json")
    if backup.exists():
        set_aside(backup)
    save_words(backup, [word])
    return f"with its examples it is kept in {backup}"


def _stored_state(name: str, module: torch.nn.Module) -> dict[str, Shaped[Array, "..."]]:
    """Return a module's weights: in half precision, unless they are too large for it, or few."""
    stored = {}
    for key, values in module.state_dict().items():
        if isinstance(values, Tensor):
            many = values.is_floating_point() and values.numel() > 256
            half = many and float(values.abs().max()) < _LARGEST_HALF
            stored[f"{name}.{key}"] = _array(values.half() if half else values)
    return stored


def _array(tensor: Tensor, kind: Any = None) -> Shaped[Array, "..."]:
    values = tensor.detach().cpu().numpy()
    return values.astype(kind or values.dtype, order="C")


# ── reading ─────────────────────────────────────────────────────────────────────────────────────────────


def read_scene(
    path: str | Path,
    device: torch.device | str | None = None,
    config: QueryConfig | None = None,
    encode_texts: EncodeTexts | None = None,
) -> Scene:
    """Read a scene file. Nothing in it is executed, and no memory is allocated beyond what it holds. device:
    by default a GPU if there is one. encode_texts: the scene's CLIP, if it is already loaded, or is not where
    the file says. Raises UserError if the file is missing, damaged, cut short, or of a newer version."""
    path, device = expanded(path), known_device(device)
    with _opened(path) as file:
        splats, decoder, codes, looks, vectors = _splats(file), None, None, None, None
        if (settings := file.about.get("decoder")) is not None:
            decoder = _decoder(file, settings)
            expect({len(w.vector) for w in file.taught} <= {decoder.clip_dim}, "a word is of another CLIP")
            fit = all(same_clip(word.clip, file.scene.clip_identity) for word in file.taught)
            expect(fit, "a word was learned with another CLIP")
            codes = _codes(file, decoder, len(splats))
        if (described := file.about.get("looks")) is not None:
            looks = _looks(file, described)
        if (words := file.about.get("words")) is not None:
            expect(all(isinstance(word, str) for word in words), "its words are no texts")
            width = file.shapes["words"][1] if decoder is None else decoder.clip_dim
            rows = file.tensor("words", len(words), width).float()
            expect(bool(rows.isfinite().all()), "its words are not made of numbers")
            vectors = dict(zip(words, F.normalize(rows, dim=1), strict=True))
        masks = [file.mask(i) for i in range(len(file.scene.photos))]
    photos = [replace(photo, mask=mask) for photo, mask in zip(file.scene.photos, masks, strict=True)]
    background = None if file.background is None else torch.tensor(file.background, device=device)
    # Moved to the device here, where its errors are not the file's.
    codes = None if codes is None else codes.to(device)
    vectors = None if vectors is None else {word: vector.to(device) for word, vector in vectors.items()}
    return Scene(
        splats.to(device), replace(file.scene, photos=photos), decoder and decoder.to(device), codes,
        looks=looks and looks.to(device), background=background, config=config or QueryConfig(),
        encode_texts=encode_texts, vectors=vectors, cache=path.with_name(f".{path.stem}.visible"),
    ).with_words(file.taught)  # fmt: skip


def describe_scene_file(path: str | Path) -> dict[str, Any]:
    """Describe a scene file, without reading a tensor: `provenance`, `scene`, `gaussians`, `photos`, `clip`,
    `decoder`, `looks`, `taught` (words) and `bytes`. Raises UserError as `read_scene` does."""
    path = expanded(path)
    with _opened(path) as file:
        return {
            "provenance": file.provenance,
            "scene": file.scene,
            "gaussians": file.shapes["means"][0],
            "photos": len(file.scene.photos),
            "clip": file.scene.clip,
            "decoder": file.about.get("decoder"),
            "looks": file.about.get("looks") is not None,
            "taught": file.taught,
            "bytes": path.stat().st_size,
        }


class _File:
    """An open safetensors file with a scene: its description, and tensors whose shapes are checked first."""

    def __init__(self, opened: Any) -> None:
        self.array = opened.get_tensor
        self.shapes = {name: opened.get_slice(name).get_shape() for name in opened.keys()}  # noqa: SIM118
        self.about: dict[str, Any] = json.loads((opened.metadata() or {})[_KEY])
        if self.about["version"] != VERSION:
            raise _NewerError(str(self.about["version"])[:40])
        self.scene: SceneRecord = scene_from_json(self.about["scene"])
        self.provenance = Provenance(**self.about["provenance"])
        expect(all(isinstance(t, str) for t in vars(self.provenance).values()), "its origin is no text")
        self.background: list[float] | None = self.about["background"]
        if self.background is not None:
            channels = [isinstance(x, int | float) and 0 <= x <= 1 for x in self.background]
            expect(channels == [True] * 3, "its background is no color")
        self.taught = words_from_json(self.about.get("taught", []))

    def tensor(self, name: str, *shape: int) -> Tensor:
        """Read a tensor of any type with this shape. Raises ValueError for another shape."""
        expect(self.shapes[name] == list(shape), f"{name} has the shape {self.shapes[name]}")
        values = self.array(name)
        expect(not values.size or bool(np.isfinite(values).any()), f"no value of {name} is a number")
        return torch.from_numpy(values.astype(np.int32) if values.dtype == np.uint16 else values)

    def mask(self, photo: int) -> bytes | None:
        """Read the PNG of a photo's foreground, after checking its size; None if the photo has no mask."""
        name = f"mask.{photo}"
        if name not in self.shapes:
            return None
        content = self.tensor(name, *self.shapes[name]).numpy().astype(np.uint8).tobytes()
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            expect(image.width * image.height <= MOST_PIXELS, "a mask is too large")
            image.verify()
        return content

    def loaded(self, name: str, module: Module, state: Mapping[str, Any] | None = None) -> Module:
        """Load a module's tensors from the file, whose shapes must be the module's, and return the module."""
        tensors = {
            key: self.tensor(f"{name}.{key}", *value.shape)
            for key, value in module.state_dict().items()
            if isinstance(value, Tensor)
        }
        expect(all(bool(t.isfinite().all()) for t in tensors.values()), f"its {name} is not made of numbers")
        module.load_state_dict({**tensors, **(state or {})})
        return module.eval().requires_grad_(False)


class _NewerError(Exception):
    """Raised for a file with an unknown format version."""


@contextmanager
def _opened(path: Path) -> Iterator[_File]:
    """Open the file, and turn errors of reading it into a UserError of one sentence."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise UserError(f"{path} is not a file: name a {SUFFIX} file")
    try:
        with ExitStack() as stack:
            place = path
            if (carried := _CARRIERS.get(path.suffix.lower())) is not None:
                if (record := carried(path)) is None:
                    raise UserError("it holds splats without words")
                place = Path(stack.enter_context(TemporaryDirectory())) / "record"
                place.write_bytes(record)
            yield _File(stack.enter_context(safe_open(place, "np")))
    except _NewerError as error:
        raise UserError(f"{path} has format {error}: a newer lang3dxl-ns wrote it; update yours") from error
    except (UserError, SafetensorError, SyntaxError, Image.DecompressionBombError, *DAMAGE) as error:
        not_of_memory(error)
        remedy = "copy it again" if path.suffix == SUFFIX else "a splat becomes one with lang3dxl attach"
        raise UserError(f"{path} is not a readable scene ({in_a_line(error)}): {remedy}") from error


def _splats(file: _File) -> Splats:
    count, bands = file.shapes["means"][0], file.shapes["harmonics"][1]
    expect(count > 0, "it holds no Gaussian")
    expect(bands in (1, 4, 9, 16), f"{bands} harmonics")
    antialiased = file.about["antialiased"]
    expect(isinstance(antialiased, bool), "antialiased")
    splats = Splats(
        file.tensor("means", count, 3).float(),
        file.tensor("quats", count, 4).float(),
        file.tensor("log_scales", count, 3).float().exp(),
        file.tensor("logits", count).float().sigmoid(),
        file.tensor("harmonics", count, bands, 3).float(),
        antialiased,
    )
    expect(bool(splats.sound().any()), "it holds no Gaussian whose values are all numbers")
    return splats


def _codes(file: _File, decoder: Decoder, count: int) -> Float[Tensor, "n d"]:
    stored = file.tensor("codes", count, decoder.code_dim or file.shapes["codes"][1])
    if not decoder.bounded:
        return stored.float()
    expect(not stored.is_floating_point(), "its codes are no coordinates")
    codes = ((stored.double() - 1) / _STEPS).clamp(1e-9, 1 - 1e-9).logit().float()
    return torch.where(stored == 0, torch.nan, codes)


def _decoder(file: _File, described: dict[str, Any]) -> Decoder:
    settings, clip, dense = described["settings"] or {}, described["clip_dim"], described["dense_dim"]
    for value in (clip, dense, *settings.values()):
        expect(isinstance(value, int | float | str), f"a decoder has the setting {value!r}")
        expect(isinstance(value, str) or 0 <= value <= _MOST_SETTING, f"a decoder has the setting {value}")
    stored = sum(prod(shape) for name, shape in file.shapes.items() if name.startswith("decoder."))
    needed = _parameters(settings, clip + dense)
    expect(needed <= 4 * stored + 10_000_000, "its decoder is larger than the file")
    config, choice = SemanticFieldConfig(preset="short", **settings), DecoderConfig(name=described["name"])
    return file.loaded("decoder", make_decoder(choice, config, clip, dense))


def _parameters(settings: Mapping[str, Any], channels: int) -> int:
    """Compute an upper bound on the number of parameters of a decoder with these settings and outputs."""
    if not settings:
        return 1000 * channels + channels**2
    levels, depth, width = (settings[name] for name in ("levels", "hidden_layers", "hidden_width"))
    most = max(settings["log2_table_size"], settings["fourier_frequencies"], levels, depth)
    expect(most <= 64, "its decoder has too many layers")
    inputs = levels * settings["features_per_level"]
    table = inputs * 2 ** int(settings["log2_table_size"])
    return table + width * (inputs + depth * width + 2 * channels + 100)


def _looks(file: _File, described: dict[str, Any]) -> AppearanceField:
    names, config = described["names"], AppearanceConfig(**described["config"])
    expect(isinstance(names, list) and all(isinstance(name, str) for name in names), "its looks' photos")
    # Before anything of that size is built; without names, vectors of any width take no bytes.
    expect(file.shapes["looks.from_photo.weight"] == [HIDDEN, config.vector_dim], "its looks")
    expect(file.shapes["looks.vectors"] == [len(names), config.vector_dim], "its looks")
    return file.loaded("looks", AppearanceField(config, names, torch.zeros(3), 1.0), {"_extra_state": names})
