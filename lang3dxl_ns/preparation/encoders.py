"""Frozen encoders that make the targets: CLIP for crops and texts, a vision transformer for dense maps.

Models are read from a local folder or, by name, through the Hugging Face cache. Code that comes with a model
is never run, and weights are read as plain tensors.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.preparation.light import in_known_light

CLIP_OPTION = "--pipeline.datamanager.clip"
DENSE_OPTION = "--pipeline.datamanager.dense"

BUILTIN = "builtin"
"""Name of the small encoders that ship with this package."""
_PREFIX = "--pipeline.datamanager."
option_prefix: ContextVar[str] = ContextVar("option_prefix", default=_PREFIX)
"""Prefix of the options in the current command: `lang3dxl prepare` has none."""
_DEMO = Path(__file__).parents[1] / "demo"
_BUILTIN_FOLDERS = {CLIP_OPTION: _DEMO / "clip", DENSE_OPTION: _DEMO / "dense"}
_WEIGHTS = ("model*.safetensors", "pytorch_model*.bin")  # the first that exists is used
_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class ModelFiles:
    """A model's local folder and a fingerprint of its contents."""

    name: str
    folder: Path
    identity: str
    """Of configuration and weights, not of the name: targets stay valid if the model is moved."""
    option: str
    """The option that chose the model, for messages."""


def find_model(name_or_dir: str | Path, option: str) -> ModelFiles:
    """A model's files: a local folder, a Hugging Face name (downloaded once), or "builtin", the CLIP
    or dense encoder that ships with this package, depending on the option.

    Raises UserError if there is no such folder, the model can't be downloaded, or files are missing.
    """
    name = str(name_or_dir)
    local = expanded(name)
    if name == BUILTIN:
        folder = _BUILTIN_FOLDERS[option]
    else:
        folder = local if local.is_dir() else _download(name, option)
    return ModelFiles(name, folder, _fingerprint(folder, option), option)


class _NotDownloaded(UserError):
    """A model is neither on disk nor can it be downloaded."""


def check_encoders(clip: str, dense: str) -> None:
    """Find both encoders, downloading missing ones; "none" and "auto" are skipped. Raises a single UserError
    that names all unavailable ones and the remedy."""
    wanted = {CLIP_OPTION: clip, DENSE_OPTION: dense}
    missing: dict[str, str] = {}
    for option, name in wanted.items():
        try:
            if name not in ("none", "auto"):
                find_model(name, option)
        except _NotDownloaded:
            missing[option] = name
    if missing:
        folders = {option: f"DIR/{name.split('/')[-1]}" for option, name in missing.items()}
        fetch = "; ".join(f"hf download {missing[o]} --local-dir {folders[o]}" for o in missing)
        use = " ".join(f"{spoken(option)} {folder}" for option, folder in folders.items())
        small = f"use the small encoders that come with this package: {spoken(CLIP_OPTION)} {BUILTIN}"
        without = f"do without dense features, which makes words less sharp: {spoken(DENSE_OPTION)} none"
        way_out = small if CLIP_OPTION in missing else without
        raise UserError(
            f"{' and '.join(missing.values())}: neither folders here nor in the Hugging Face cache, and "
            f"the download fails. Either {way_out}. Or, on a machine with Internet: {fetch}; copy DIR here, "
            f"and use {use}"
        )


def spoken(option: str) -> str:
    """An option as spelled in the current command."""
    return option.replace(_PREFIX, option_prefix.get())


class ImageTextEncoder:
    """CLIP: images and texts in one space. Embeddings are projected, float32 and *not* normalized.

    `dim`: channels; `crop_size`: side of the vision tower's input in pixels; `identity`: of the weights;
    `brightness`: mean value of the photos that it has learned from, if it depends on that, else None.
    """

    def __init__(
        self,
        model: Any,
        tokenizer: Any,
        mean: Sequence[float],
        std: Sequence[float],
        identity: str,
        brightness: float | None = None,
    ) -> None:
        self.dim: int = model.config.projection_dim
        self.crop_size: int = model.config.vision_config.image_size
        self.identity, self.brightness = identity, brightness
        self._model, self._tokenizer = model, tokenizer
        self._device = next(model.parameters()).device
        self._mean, self._std = _channels(mean, self._device), _channels(std, self._device)
        self._context: int = model.config.text_config.max_position_embeddings

    def in_known_light(self, photo: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """A photo as its crops should be cut from: in the light that the encoder knows."""
        return photo if self.brightness is None else in_known_light(photo, self.brightness)

    # no_grad, not inference_mode: embeddings may enter autograd later, inference tensors can't
    @torch.no_grad()
    def encode_images(self, crops: Float[Tensor, "n 3 s s"]) -> Float[Tensor, "n c"]:
        """Embeddings of square crops, RGB in 0…1, on the encoder's device; other sizes are resized first."""
        crops = _resize(crops.to(self._device, torch.float32), self.crop_size)
        with _precision_of_images(self._device):
            output = self._model.get_image_features(pixel_values=(crops - self._mean) / self._std)
        return output.pooler_output.float()

    @torch.no_grad()
    def encode_texts(self, texts: list[str]) -> Float[Tensor, "n c"]:
        """Embeddings of texts, on the encoder's device; truncated to the model's context."""
        tokens = self._tokenizer(
            texts, padding=True, truncation=True, max_length=self._context, return_tensors="pt"
        ).to(self._device)
        with _half_precision_on_cuda(self._device):
            output = self._model.get_text_features(**tokens)
        return output.pooler_output.float()


class DenseEncoder:
    """A vision transformer (DINOv2 …) whose patch tokens are dense features: `tokens`² of `dim` channels."""

    def __init__(self, model: Any, tokens: int, identity: str) -> None:
        self.dim: int = model.config.hidden_size
        self.tokens = tokens
        self.identity = identity
        self._model = model
        self._side = tokens * model.config.patch_size
        self._device = next(model.parameters()).device
        self._mean, self._std = (
            _channels(_IMAGENET_MEAN, self._device),
            _channels(_IMAGENET_STD, self._device),
        )
        # a plain ViT rejects other image sizes by default; DINOv2 always interpolates, without the argument
        interpolates = "interpolate_pos_encoding" in inspect.signature(model.forward).parameters
        self._arguments = {"interpolate_pos_encoding": True} if interpolates else {}

    @torch.no_grad()
    def encode(self, photo: Float[Tensor, "h w 3"]) -> Float[Tensor, "t t d"]:
        """Normalized patch tokens of the last layer, float32, for a photo (RGB in 0…1) squashed to a square.

        Token (i, j) covers rows i/t…(i+1)/t and columns j/t…(j+1)/t of the photo.
        """
        image = _resize(photo.to(self._device, torch.float32).permute(2, 0, 1)[None], self._side)
        with _half_precision_on_cuda(self._device):
            output = self._model(pixel_values=(image - self._mean) / self._std, **self._arguments)
        # class and register tokens come first
        patches = output.last_hidden_state[0, -(self.tokens**2) :].float()
        return patches.reshape(self.tokens, self.tokens, self.dim)


def load_image_text_encoder(name_or_dir: str | Path, device: torch.device | str) -> ImageTextEncoder:
    """CLIP in Hugging Face format, from a folder, by name, or "builtin".

    Raises UserError if it can't be found or downloaded, isn't a CLIP, or is incomplete.
    """
    from transformers import CLIPImageProcessor, CLIPModel, CLIPTokenizer

    files = find_model(name_or_dir, CLIP_OPTION)
    if files.name == BUILTIN:
        _say_what_builtin_knows()
    kind = model_type(files)
    if kind != "clip":
        raise UserError(
            f"{files.name} is a {kind} model: {spoken(files.option)} needs a CLIP in Hugging Face format, "
            "such as openai/clip-vit-base-patch32"
        )
    model = load_weights(CLIPModel, files, device)
    if not _has(files.folder, "tokenizer.json") and not _has(files.folder, "vocab.json", "merges.txt"):
        # transformers would silently make a tokenizer without words
        raise UserError(
            f"{files.folder} has no tokenizer (tokenizer.json, or vocab.json and merges.txt): "
            "copy these files from the model that this one was fine-tuned from"
        )
    tokenizer = CLIPTokenizer.from_pretrained(files.folder, local_files_only=True)
    if _has(files.folder, "preprocessor_config.json") or _has(files.folder, "processor_config.json"):
        processor = CLIPImageProcessor.from_pretrained(files.folder, local_files_only=True)
    else:
        processor = CLIPImageProcessor()  # fine-tuned weights are often saved alone; CLIP's own statistics
    return ImageTextEncoder(
        model,
        tokenizer,
        processor.image_mean,
        processor.image_std,
        files.identity,
        getattr(processor, "brightness", None),  # a key of our own, in the built-in CLIP's folder
    )


def load_dense_encoder(name_or_dir: str | Path, device: torch.device | str, tokens: int = 64) -> DenseEncoder:
    """DINOv2 or another vision transformer with patch tokens, read at `tokens`×`tokens`.

    Raises UserError if it can't be found or downloaded, has no patch tokens, or is incomplete.
    """
    from transformers import AutoModel

    files = find_model(name_or_dir, DENSE_OPTION)
    model = load_weights(AutoModel, files, device)
    if not isinstance(getattr(model.config, "patch_size", None), int):
        raise UserError(
            f"{files.name} is a {model.config.model_type} model without patch tokens: give "
            f"{spoken(files.option)} "
            'a vision transformer such as facebook/dinov2-small, or "none"'
        )
    return DenseEncoder(model, tokens, files.identity)


@lru_cache(maxsize=1)  # log once
def _say_what_builtin_knows() -> None:
    from rich import get_console

    get_console().print(
        "The built-in CLIP knows landmarks and street façades and nothing else; a real one knows more: "
        f"{spoken(CLIP_OPTION)} openai/clip-vit-base-patch32",
        soft_wrap=True,
    )


def load_weights(model_class: Any, files: ModelFiles, device: torch.device | str) -> Any:
    """The model, frozen and in float32. Missing weights are an error, not random numbers."""
    from safetensors import SafetensorError
    from transformers.utils import logging

    logging.disable_progress_bar()  # a second's work, and it would draw over ours
    try:
        model, report = model_class.from_pretrained(
            files.folder,
            local_files_only=True,
            trust_remote_code=False,
            dtype=torch.float32,
            output_loading_info=True,
        )
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise UserError(
            f"{files.name}: the model in {files.folder} can't be loaded ({error}): download it again, or "
            f"give {spoken(files.option)} another folder"
        ) from error
    missing = sorted(name for name in report["missing_keys"] if "pooler" not in name)  # poolers are not used
    if missing:
        raise UserError(
            f"{files.name}: the weights in {files.folder} lack {len(missing)} tensors, the first being "
            f"{missing[0]}: give {spoken(files.option)} a complete model"
        )
    return model.to(device).eval().requires_grad_(False)


def model_type(files: ModelFiles) -> str:
    """The model type in its configuration ("clip"). Raises UserError if there is none."""
    from transformers import AutoConfig

    try:
        return AutoConfig.from_pretrained(files.folder, trust_remote_code=False).model_type
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{files.folder / 'config.json'} is not a model's configuration: {error}") from error


def _download(name: str, option: str) -> Path:
    """The folder of a model in the Hugging Face cache, downloaded on first use."""
    from huggingface_hub import snapshot_download

    try:
        for weights in _WEIGHTS:
            folder = Path(snapshot_download(name, allow_patterns=["*.json", "*.txt", weights]))
            if _weight_files(folder):
                return folder
    except (OSError, ValueError) as error:  # no network, no such model, not a name
        raise _NotDownloaded(
            f"the model {name} is neither a folder here nor in the Hugging Face cache, and it can't be "
            f"downloaded ({type(error).__name__}). On a machine with Internet: "
            f"hf download {name} --local-dir DIR; then {spoken(option)} DIR"
        ) from error
    raise UserError(f"the model {name} has no PyTorch weights ({' or '.join(_WEIGHTS)}): choose another")


def _weight_files(folder: Path) -> list[Path]:
    found = (sorted(folder.glob(pattern)) for pattern in _WEIGHTS)
    return next((files for files in found if files), [])


def _fingerprint(folder: Path, option: str) -> str:
    """16 hex digits of everything that affects an image's embedding."""
    config = folder / "config.json"
    weights = _weight_files(folder)
    if not config.is_file() or not weights:
        raise UserError(
            f"{folder} is not a model in Hugging Face format: it needs config.json and "
            f"{' or '.join(_WEIGHTS)}; give {spoken(option)} the folder that holds them"
        )
    preprocessing = sorted(folder.glob("p*processor_config.json"))
    digests = []
    for path in [config, *preprocessing, *weights]:
        status = path.stat()
        digests.append(_digest(path, status.st_size, status.st_mtime_ns))
    return hashlib.sha256("".join(digests).encode()).hexdigest()[:16]


@lru_cache(maxsize=64)
def _digest(path: Path, size: int, modified_ns: int) -> str:
    """A file's SHA-256 (about a second per gigabyte), cached by size and modification time."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _has(folder: Path, *names: str) -> bool:
    return all((folder / name).is_file() for name in names)


def _channels(values: Sequence[float], device: torch.device) -> Float[Tensor, "3 1 1"]:
    return torch.tensor(values, dtype=torch.float32, device=device)[:, None, None]


def _resize(images: Float[Tensor, "n 3 h w"], side: int) -> Float[Tensor, "n 3 side side"]:
    """Images squashed to squares, antialiased bicubic, as in the training of both models."""
    if images.shape[-2:] == (side, side):
        return images
    return F.interpolate(images, (side, side), mode="bicubic", antialias=True).clamp(0.0, 1.0)


def _precision_of_images(device: torch.device) -> torch.autocast:
    """16 bits where the hardware multiplies them: float16 on a GPU, bfloat16 on some CPUs."""
    if device.type == "cpu":
        return torch.autocast("cpu", dtype=torch.bfloat16, enabled=_multiplies_bfloat16())
    return _half_precision_on_cuda(device)


@cache
def _multiplies_bfloat16() -> bool:
    """Whether this machine's CPU does. Elsewhere bfloat16 is slower than float32."""
    try:
        from llvmlite.binding import get_host_cpu_features
    except ImportError:
        return False
    features = get_host_cpu_features()
    return bool(features.get("avx512bf16") or features.get("amx-bf16"))


def _half_precision_on_cuda(device: torch.device) -> torch.autocast:
    """float16 rather than bfloat16: three more bits, and the targets are stored in it anyway."""
    return torch.autocast(device.type, dtype=torch.float16, enabled=device.type == "cuda")
