"""Frozen encoders that make the targets: image-text encoders, and vision transformers for dense maps."""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.device import multiplies_bfloat16
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.preparation.families import (
    FAMILIES,
    Family,
    PatchHead,
    head_recipe,
    input_side,
    patch_tokens,
    read_patch_head,
    vision_inputs,
)
from lang3dxl_ns.preparation.model_files import (
    BUILTIN,
    CLIP_OPTION,
    DENSE_OPTION,
    ModelFiles,
    find_model,
    has_files,
    load_weights,
    read_config,
    whole,
)
from lang3dxl_ns.preparation.settings import DENSE_MODEL, PreparationConfig

_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_NORMALIZE_THEMSELVES = ("radio",)
"""Vision transformers that take pictures in 0…1."""
_HEAD_ROWS = 16
"""Number of rows of a map that a head for patches reads at once, to bound memory."""
_DIM = 0.75
"""Share of the known brightness below which a photo is dark; nearly all photos of landmarks are above it."""
_DARKEST = 0.02
"""Lower bound on a photo's mean brightness, so that black photos stay black and exponents stay moderate."""
_VOCABULARIES = (
    ("tokenizer.json",),
    ("vocab.json", "merges.txt"),
    ("spiece.model",),
    ("sentencepiece.bpe.model",),
    ("tokenizer.model",),
)
"""Files of which a tokenizer needs one set."""


class ImageTextEncoder:
    """Images and texts in one space: CLIP, SigLIP, TIPSv2 … Embeddings are projected, float32 and *not*
    normalized. `dim`: channels; `crop_size`: side in pixels of the pictures that the vision tower was trained
    on; `patch_size`: side of its patches; `identity`: of the weights; `brightness`: mean value of the photos
    that it has learned from, if it depends on that, else None."""

    def __init__(
        self,
        model: Any,
        tokenizer: Any,
        mean: Sequence[float],
        std: Sequence[float],
        identity: str,
        brightness: float | None = None,
        resample: Literal["bilinear", "bicubic"] = "bicubic",
        head: PatchHead | None = None,
    ) -> None:
        vision, text = model.config.vision_config, model.config.text_config
        self.crop_size, self.patch_size = input_side(vision), int(vision.patch_size)
        self.identity, self.brightness = identity, brightness
        self._family: Family = FAMILIES[model.config.model_type]
        self._head = head
        self._model, self._tokenizer, self._resample = model, tokenizer, resample
        self._device = next(model.parameters()).device
        self._mean, self._std = _channels(mean, self._device), _channels(std, self._device)
        positions = text.max_position_embeddings - self._family.first_position
        self._context = min(positions, tokenizer.model_max_length)
        self.dim: int = self.encode_texts(["object"]).shape[-1]

    def in_known_light(self, photo: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """Bring a photo into the light that the encoder knows, before crops are cut from it."""
        return photo if self.brightness is None else in_known_light(photo, self.brightness)

    @torch.no_grad()  # not inference_mode: embeddings may enter autograd later, inference tensors can't
    def encode_images(self, crops: Float[Tensor, "n 3 s s"]) -> Float[Tensor, "n c"]:
        """Embed square crops, RGB in 0…1, on the encoder's device. Other sizes are resized first."""
        crops = _resize(crops.to(self._device, torch.float32), self.crop_size, self._resample)
        with _precision_of_images(self._device):
            inputs = vision_inputs(self._model, (crops - self._mean) / self._std)
            output = self._model.get_image_features(**inputs)
        return output.pooler_output.float()

    @torch.no_grad()
    def encode_patches(self, windows: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n rows columns c"]:
        """Compute features of patches, which `join_sizes` makes comparable with texts. The sides of windows
        (RGB in 0…1) are whole patches. The result is on the encoder's device."""
        rows, columns = (side // self.patch_size for side in windows.shape[-2:])
        windows = windows.to(self._device, torch.float32)
        read = self._family.patches if self._head is None else patch_tokens
        with _precision_of_images(self._device):
            patches = read(self._model, (windows - self._mean) / self._std)
        return patches.float().unflatten(1, (rows, columns))

    @torch.no_grad()
    def join_sizes(self, features: Float[Tensor, "sizes rows columns d"]) -> Float[Tensor, "rows columns c"]:
        """Join maps of windows of several sizes, coarse to fine, by the head, or else by their mean."""
        if self._head is None:
            return features.mean(0)
        # A few rows at a time, because the head's input is several times as wide as its output.
        return torch.cat([self._head(rows) for rows in features.split(_HEAD_ROWS, dim=1)])

    @torch.no_grad()
    def encode_texts(self, texts: list[str]) -> Float[Tensor, "n c"]:
        """Embed texts, cut to the model's context, on the encoder's device."""
        fixed = self._family.fixed_length
        tokens = self._tokenizer(
            [text.lower() for text in texts] if fixed else texts,
            padding="max_length" if fixed else True,
            truncation=True,
            max_length=self._context,
            return_tensors="pt",
        ).to(self._device)
        with _half_precision_on_cuda(self._device):
            inputs = {name: tokens[name] for name in self._family.text_inputs}
            output = self._model.get_text_features(**inputs)
        return output.pooler_output.float()


@dataclass(frozen=True)
class PatchReading:
    """How an encoder makes a map of a photo, known from its files alone."""

    recipe: str
    tokens: int
    """Patches per side of its own input."""
    sizes: int | None
    """Number of window sizes that its head reads, each twice as large as the one before; None without one."""
    fine_alone: bool
    """Whether only training photos are read as maps. The crops of the others are the 2-D teacher."""


def patch_reading(clip: str, features: Literal["auto", "crops", "dense"]) -> PatchReading | None:
    """Return how an encoder (a name or folder) makes maps; None if it reads crops alone. Raises UserError
    like `load_image_text_encoder`."""
    files = find_model(clip, CLIP_OPTION)
    family, head = _family(files), head_recipe(files.folder)
    by_crops = (family.features if features == "auto" else features) == "crops"
    if features == "crops" or (by_crops and head is None):
        return None
    vision = read_config(files).vision_config
    recipe, sizes = head or (family.recipe, None)
    return PatchReading(recipe, input_side(vision) // vision.patch_size, sizes, by_crops)


def usual_dense(config: PreparationConfig, learned: bool) -> str:
    """Resolve the dense encoder "auto" of a configuration; another name is returned as it is. `learned` says
    whether the semantics learn dense features, as in the paper, instead of sharpening by them."""
    if config.dense != "auto":
        return config.dense
    with suppress(UserError):  # `check_encoders` reports a missing CLIP, and a missing dense encoder with it
        reading = None if learned else patch_reading(config.clip, config.clip_features)
        if reading is not None and reading.sizes is not None:
            return "none"
    return BUILTIN if config.clip == BUILTIN else DENSE_MODEL


def _family(files: ModelFiles) -> Family:
    kind = read_config(files).model_type
    if kind not in FAMILIES:
        raise UserError(
            f"{files.name} is a {kind} model: {data_option(files.option)} needs an image-text encoder in "
            f"Hugging Face format ({', '.join(FAMILIES)}), such as openai/clip-vit-base-patch32"
        )
    return FAMILIES[kind]


class DenseEncoder:
    """A vision transformer (DINOv2 …) whose patch tokens are dense features: `tokens`² of `dim` channels."""

    def __init__(self, model: Any, tokens: int, identity: str) -> None:
        self.dim: int = model.config.hidden_size
        self.tokens = tokens
        self.identity = identity
        self._model = model
        self._side = tokens * model.config.patch_size
        self._device = next(model.parameters()).device
        own = model.config.model_type in _NORMALIZE_THEMSELVES
        self._mean = _channels((0.0, 0.0, 0.0) if own else _IMAGENET_MEAN, self._device)
        self._std = _channels((1.0, 1.0, 1.0) if own else _IMAGENET_STD, self._device)
        # a plain ViT rejects other image sizes by default; DINOv2 always interpolates, without the argument
        interpolates = "interpolate_pos_encoding" in inspect.signature(model.forward).parameters
        self._arguments = {"interpolate_pos_encoding": True} if interpolates else {}

    @torch.no_grad()
    def encode(self, photo: Float[Tensor, "h w 3"]) -> Float[Tensor, "t t d"]:
        """Compute normalized patch tokens of the last layer, float32, for a photo (RGB in 0…1) squashed to a
        square. Token (i, j) covers rows i/t…(i+1)/t and columns j/t…(j+1)/t of the photo."""
        image = _resize(photo.to(self._device, torch.float32).permute(2, 0, 1)[None], self._side)
        with _half_precision_on_cuda(self._device):
            output = self._model(pixel_values=(image - self._mean) / self._std, **self._arguments)
        # class and register tokens come first
        patches = output.last_hidden_state[0, -(self.tokens**2) :].float()
        return patches.reshape(self.tokens, self.tokens, self.dim)


def load_image_text_encoder(name_or_dir: str | Path, device: torch.device | str) -> ImageTextEncoder:
    """Load an image-text encoder in Hugging Face format, from a folder, by name, or "builtin". Raises
    UserError if it can't be found or downloaded, is of no known family, or is incomplete."""
    from transformers import AutoModel

    files = find_model(name_or_dir, CLIP_OPTION)
    _family(files)
    model = load_weights(AutoModel, files, device)
    processor = _image_processor(files)
    normalizes = getattr(processor, "do_normalize", True)
    with whole(f"the files in {files.folder} don't fit each other", "download the model again"):
        return ImageTextEncoder(
            model,
            _tokenizer(files),
            processor.image_mean if normalizes else (0.0, 0.0, 0.0),
            processor.image_std if normalizes else (1.0, 1.0, 1.0),
            files.clip_identity,
            getattr(processor, "brightness", None),  # a key of our own, in the built-in CLIP's folder
            "bilinear" if int(processor.resample) == 2 else "bicubic",
            read_patch_head(files.folder, device),
        )


def _tokenizer(files: ModelFiles) -> Any:
    """Load a model's tokenizer. Raises UserError if its files are missing or can't be read."""
    from transformers import AutoTokenizer

    if not any(has_files(files.folder, *names) for names in _VOCABULARIES):
        # transformers would silently make a tokenizer without words
        raise UserError(
            f"{files.folder} has no tokenizer ({', '.join(' and '.join(names) for names in _VOCABULARIES)}): "
            "copy these files from the model that this one was fine-tuned from"
        )
    remedy = "SigLIP and TIPSv2 need `pip install sentencepiece protobuf`; otherwise download the model again"
    with whole(f"the tokenizer in {files.folder} can't be read", remedy):
        return AutoTokenizer.from_pretrained(files.folder, local_files_only=True, trust_remote_code=False)


def _image_processor(files: ModelFiles) -> Any:
    """Load the settings of a model's image preprocessing."""
    from transformers import AutoImageProcessor, CLIPImageProcessor

    if not any(has_files(files.folder, f"{kind}_config.json") for kind in ("preprocessor", "processor")):
        if read_config(files).model_type == "clip":
            return CLIPImageProcessor()  # fine-tuned weights are often saved alone; CLIP's own statistics
        raise UserError(
            f"{files.folder} has no preprocessor_config.json: copy it from the model that this one was "
            "fine-tuned from"
        )
    with whole(f"{files.folder / 'preprocessor_config.json'} can't be read", "download the model again"):
        return AutoImageProcessor.from_pretrained(
            files.folder, local_files_only=True, trust_remote_code=False
        )


def load_dense_encoder(name_or_dir: str | Path, device: torch.device | str, tokens: int = 64) -> DenseEncoder:
    """Load DINOv2 or another vision transformer with patch tokens, to read photos at `tokens`×`tokens`.
    Raises UserError if it can't be found or downloaded, has no patch tokens, or is incomplete."""
    from transformers import AutoModel

    files = find_model(name_or_dir, DENSE_OPTION)
    model = load_weights(AutoModel, files, device)
    if not isinstance(getattr(model.config, "patch_size", None), int):
        raise UserError(
            f"{files.name} is a {model.config.model_type} model without patch tokens: give "
            f'{data_option(files.option)} a vision transformer such as facebook/dinov2-small, or "none"'
        )
    return DenseEncoder(model, tokens, files.identity)


def in_known_light(photo: Float[Tensor, "h w 3"], brightness: float) -> Float[Tensor, "h w 3"]:
    """Bring a dark photo (RGB in 0…1) to about this mean, the same in all channels; others stay unchanged. A
    gamma curve sets the brightness, which keeps black and white. Then each channel is multiplied (gray
    world), which removes a tint. Encoders trained on millions of photos need neither."""
    mean = max(float(photo.mean()), _DARKEST)
    if mean >= _DIM * brightness:
        return photo
    lit = photo ** (math.log(brightness) / math.log(mean))
    channels = lit.mean((0, 1))
    return (lit * (channels.mean() / channels.clamp_min(_DARKEST))).clamp(0, 1)


def _channels(values: Sequence[float], device: torch.device) -> Float[Tensor, "3 1 1"]:
    return torch.tensor(values, dtype=torch.float32, device=device)[:, None, None]


def _resize(
    images: Float[Tensor, "n 3 h w"], side: int, mode: str = "bicubic"
) -> Float[Tensor, "n 3 side side"]:
    """Squash images to squares, antialiased, as in the training of the models."""
    if images.shape[-2:] == (side, side):
        return images
    return F.interpolate(images, (side, side), mode=mode, antialias=True).clamp(0.0, 1.0)


def _precision_of_images(device: torch.device) -> torch.autocast:
    """Use 16 bits where the hardware multiplies them: float16 on a GPU, bfloat16 on some CPUs."""
    if device.type == "cpu":
        return torch.autocast("cpu", dtype=torch.bfloat16, enabled=multiplies_bfloat16())
    return _half_precision_on_cuda(device)


def _half_precision_on_cuda(device: torch.device) -> torch.autocast:
    """Use float16, not bfloat16: it has three more bits, and the targets are stored in it anyway."""
    return torch.autocast(device.type, dtype=torch.float16, enabled=device.type == "cuda")
