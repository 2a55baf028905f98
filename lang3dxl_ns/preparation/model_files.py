"""Finding and loading the files of pretrained models: local folders, the Hugging Face cache, downloads.

Code that comes with a model is never run, and weights are read as plain tensors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch

from lang3dxl_ns.common.errors import UserError, in_a_line, readable
from lang3dxl_ns.common.files import check_regular, expanded
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.preparation.settings import DENSE_MODEL

CLIP_OPTION, DENSE_OPTION = "clip", "dense"

BUILTIN = "builtin"
"""Name of the small encoders that ship with this package."""
USUAL_CLIP = "openai/clip-vit-base-patch32"
"""CLIP that "auto" chooses where it was downloaded before."""
_DEMO = Path(__file__).parents[1] / "demo"
_BUILTIN_FOLDERS = {CLIP_OPTION: _DEMO / "clip", DENSE_OPTION: _DEMO / "dense"}
_WEIGHTS = ("model*.safetensors", "pytorch_model*.bin")  # the first that exists is used
_TOKENIZER = ("tokenizer.json", "vocab.json", "merges.txt", "*.model")
"""Files that decide how a text becomes tokens."""
_FILES = ("*.json", "*.txt", "*.model")
"""Patterns of configuration, vocabularies, and SentencePiece models."""
_MOST_LAYERS = 1000
"""Largest number of layers of a network; a damaged number would keep transformers building for hours."""


@dataclass(frozen=True)
class ModelFiles:
    """Local folder of a model, with a fingerprint of its contents."""

    name: str
    folder: Path
    identity: str
    """Fingerprint of configuration and weights, not of the name, so targets stay valid if the model moves."""
    option: str
    """Name of the option that chose the model, for messages."""

    @property
    def clip_identity(self) -> str:
        """Fingerprint of a CLIP: `identity` and, after a dot, that of its tokenizer, on which the vectors of
        texts depend but no target does."""
        files = sorted(path for name in _TOKENIZER for path in self.folder.glob(name))
        return f"{self.identity}.{_digest_of_all(files)}"

    @property
    def address(self) -> str:
        """Name or whole path by which the model is found again, also from another folder."""
        local = expanded(self.name)
        return str(local.absolute()) if local.is_dir() else self.name


def find_model(name_or_dir: str | Path, option: str) -> ModelFiles:
    """Find a model's files by a local folder, a Hugging Face name (downloaded once), or "builtin", which is
    the CLIP or dense encoder that ships with this package, depending on the option. Raises UserError if there
    is no such folder, the model can't be downloaded, or files are missing."""
    name = str(name_or_dir)
    local = expanded(name)
    if name == BUILTIN and option in _BUILTIN_FOLDERS:
        folder = _BUILTIN_FOLDERS[option]
    else:
        folder = local if local.is_dir() else _download(name, option)
    return ModelFiles(name, folder, _fingerprint(folder, option), option)


def usual_clip(clip: str, dense: str) -> str:
    """Resolve the image-text encoder "auto": OpenAI's CLIP if it is in the Hugging Face cache, and the dense
    encoder that "auto" takes with it too, otherwise the built-in one, so that nothing is downloaded unasked.
    Another name is returned as it is."""
    from huggingface_hub import try_to_load_from_cache

    if clip != "auto":
        return clip
    wanted, names = [USUAL_CLIP], ("model.safetensors", "pytorch_model.bin")
    if dense == "auto":
        wanted.append(DENSE_MODEL)
    here = all(any(isinstance(try_to_load_from_cache(model, n), str) for n in names) for model in wanted)
    return USUAL_CLIP if here else BUILTIN


class _NotDownloaded(UserError):
    """Error for a model that is not on disk and can't be downloaded."""


def check_encoders(clip: str, dense: str) -> None:
    """Find both encoders, downloading missing ones; "none" and "auto" are skipped. Raises a single UserError
    that names all unavailable ones and the remedy."""
    wanted = {CLIP_OPTION: clip, DENSE_OPTION: dense}
    missing, reason = dict[str, str](), ""
    for option, name in wanted.items():
        try:
            if name not in ("none", "auto"):
                find_model(name, option)
        except _NotDownloaded as error:
            missing[option], reason = name, in_a_line(error.__cause__ or error)
    if missing:
        folders = {option: f"DIR/{name.split('/')[-1]}" for option, name in missing.items()}
        fetch = "; ".join(f"hf download {missing[o]} --local-dir {folders[o]}" for o in missing)
        use = " ".join(f"{data_option(option)} {folder}" for option, folder in folders.items())
        small = f"use the small encoders that come with this package: {data_option(CLIP_OPTION)} {BUILTIN}"
        without = f"do without dense features, which makes words less sharp: {data_option(DENSE_OPTION)} none"
        way_out = small if CLIP_OPTION in missing else without
        raise UserError(
            f"{' and '.join(missing.values())}: neither folders here nor in the Hugging Face cache, and "
            f"the download fails ({reason}). Either {way_out}. Or, on a machine with Internet: {fetch}; copy "
            f"DIR here, and use {use}"
        )


def load_weights(model_class: Any, files: ModelFiles, device: torch.device | str) -> Any:
    """Load a model, frozen and in float32. Raises UserError for missing weights, which transformers would
    fill with random numbers."""
    from transformers.utils import logging

    logging.disable_progress_bar()  # loading takes a second, and its bar would draw over ours
    logging.set_verbosity_error()  # it logs tables of tensors; missing ones are reported below
    read_config(files)
    remedy = f"download it again, or give {data_option(files.option)} another folder"
    with whole(f"{files.name}: the model in {files.folder} can't be loaded", remedy):
        model, report = model_class.from_pretrained(
            files.folder,
            local_files_only=True,
            trust_remote_code=False,
            dtype=torch.float32,
            output_loading_info=True,
        )
    missing = sorted(name for name in report["missing_keys"] if "pooler" not in name)  # poolers are not used
    if missing:
        raise UserError(
            f"{files.name}: the weights in {files.folder} lack {len(missing)} tensors, the first being "
            f"{missing[0]}: give {data_option(files.option)} a complete model"
        )
    return model.to(device).eval().requires_grad_(False)


def load_processor(processor_class: Any, files: ModelFiles) -> Any:
    """Load the preprocessor of a network's images and texts. Raises UserError if its files are missing."""
    remedy = "copy its preprocessor_config.json and tokenizer files there, or download the model again"
    with whole(f"{files.folder} lacks files that preprocess the input of {files.name}", remedy):
        return processor_class.from_pretrained(files.folder, local_files_only=True)


def read_config(files: ModelFiles) -> Any:
    """Read a model's configuration. Raises UserError for a file that isn't one."""
    from transformers import AutoConfig

    with whole(f"{files.folder / 'config.json'} is not a model's configuration", "download the model again"):
        config = AutoConfig.from_pretrained(files.folder, trust_remote_code=False)
        for part in (config, getattr(config, "vision_config", None), getattr(config, "text_config", None)):
            layers = getattr(part, "num_hidden_layers", 1)
            if isinstance(layers, int) and not 0 < layers <= _MOST_LAYERS:
                raise ValueError(f"it has {layers} layers")
    return config


whole = partial(readable, errors=(Exception,), most=300)
"""Like `readable`, for transformers, which damaged files make fail in any way."""


def _download(name: str, option: str) -> Path:
    """Return the folder of a model in the Hugging Face cache, after downloading it on first use."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import GatedRepoError

    try:
        for weights in _WEIGHTS:
            folder = Path(snapshot_download(name, allow_patterns=[*_FILES, weights]))
            if _weight_files(folder):
                return folder
    except GatedRepoError as error:
        raise UserError(
            f"{name} is gated: accept its license at https://huggingface.co/{name}, log in here with "
            "`hf auth login`, and run the same command again"
        ) from error
    except Exception as error:  # no network, no such model, not a name, an unusable proxy
        raise _NotDownloaded(
            f"the model {name} is neither a folder here nor in the Hugging Face cache, and it can't be "
            f"downloaded ({in_a_line(error)}). On a machine with Internet: "
            f"hf download {name} --local-dir DIR; then {data_option(option)} DIR"
        ) from error
    raise UserError(f"the model {name} has no PyTorch weights ({' or '.join(_WEIGHTS)}): choose another")


def _weight_files(folder: Path) -> list[Path]:
    found = (sorted(folder.glob(pattern)) for pattern in _WEIGHTS)
    return next((files for files in found if files), [])


def _fingerprint(folder: Path, option: str) -> str:
    """Compute 16 hex digits from all files that affect an image's embedding."""
    config = folder / "config.json"
    weights = _weight_files(folder)
    if not config.is_file() or not weights:
        raise UserError(
            f"{folder} is not a model in Hugging Face format: it needs config.json and "
            f"{' or '.join(_WEIGHTS)}; give {data_option(option)} the folder that holds them"
        )
    for path in (path for pattern in (*_FILES, *_WEIGHTS) for path in folder.glob(pattern)):
        try:
            check_regular(path)
        except OSError as error:
            raise UserError(f"{path} can't be read ({error.strerror}): download the model again") from error
    return _digest_of_all([config, *sorted(folder.glob("p*processor_config.json")), *weights])


def _digest_of_all(paths: Sequence[Path]) -> str:
    """Compute 16 hex digits from the contents of files, in their order."""
    digests = [_digest(path, path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    return hashlib.sha256("".join(digests).encode()).hexdigest()[:16]


@lru_cache(maxsize=64)
def _digest(path: Path, size: int, modified_ns: int) -> str:
    """Compute a file's SHA-256 (about a second per gigabyte), cached by size and modification time."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def has_files(folder: Path, *names: str) -> bool:
    """Return whether a folder has all of these files."""
    return all((folder / name).is_file() for name in names)
