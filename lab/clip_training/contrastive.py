"""Losses of the small CLIP's training: how well captions fit crops, and soft contrastive targets from it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from torch import Tensor

from lab.clip_training.captions import FIT_OF_LABEL, FITS, MAY_BE, Caption

GENERIC_SHARE = 0.1
"""How well a canonical phrase fits any crop, and the share of such captions."""
_DOUBT = 0.12  # share of a crop that may show a class unnamed, above which the pair is ignored
_MISMATCH = 0.3  # fit of a caption with the right class but the wrong adjective or family


def caption_fit(
    captions: list[Caption],
    shares: Float[Array, "n k"],
    materials: Int[Array, "n k"],
    families: Int[Array, " n"],
) -> Float[Array, "n t"]:
    """How well each caption fits each crop: its class's share, reduced for a wrong adjective or family."""
    classes = [caption.class_ for caption in captions]
    everywhere = np.broadcast_to([GENERIC_SHARE, 0.0], (len(shares), 2))  # GENERIC and ABSENT
    fit = np.concatenate([shares @ FIT_OF_LABEL, everywhere], axis=1)[:, classes]
    for column, caption in zip(fit.T, captions, strict=True):
        if caption.adjective >= 0:
            material = materials[:, caption.class_]
            fits = (material >= 0) & FITS[caption.adjective][material]
            column *= np.where(fits, 1.0, _MISMATCH)
        if caption.family >= 0:
            column *= np.where(families == caption.family, 1.0, _MISMATCH)
    return fit


def in_doubt(
    captions: list[Caption], labels: Float[Array, "n l"], fit: Float[Array, "n t"]
) -> Bool[Array, "n t"]:
    """Crops that may show a caption's class unnamed, or are hardly labeled: ignored for this caption."""
    hidden = labels @ MAY_BE
    hidden = np.concatenate([hidden, np.zeros((len(labels), 2))], axis=1)[:, [c.class_ for c in captions]]
    return ((hidden > _DOUBT) & (fit < hidden)) | (labels[:, -1:] > 0.5)


def contrastive_loss(
    images: Float[Tensor, "n d"],
    texts: Float[Tensor, "t d"],
    fit: Float[Tensor, "n t"],
    classes: Int[Tensor, " t"],
    scale: Float[Tensor, ""],
    doubt: Bool[Tensor, "n t"] | None = None,
) -> Float[Tensor, ""]:
    """Soft cross entropy of image→text and text→image, for unit embeddings of crops and captions.

    The targets are proportional to `fit`; image→text divides a class's share among its captions. Pairs in
    `doubt` are left out.
    """
    logits = scale * images @ texts.T
    if doubt is not None:
        logits, fit = logits.masked_fill(doubt, -1e4), fit.masked_fill(doubt, 0.0)
    shared = fit / (classes[:, None] == classes).sum(0)
    per_image = shared / shared.sum(1, keepdim=True).clamp(min=1e-6)
    per_text = fit / fit.sum(0, keepdim=True).clamp(min=1e-6)
    image_loss = -(per_image * logits.log_softmax(1)).sum(1).mean()
    text_loss = -(per_text * logits.log_softmax(0)).sum(0).mean()
    return (image_loss + text_loss) / 2


def patch_loss(logits: Float[Tensor, "n p k"], shares: Float[Tensor, "n p k"]) -> Float[Tensor, ""]:
    """Soft cross entropy of the patches inside the view; it teaches the patch tokens their classes."""
    return -(shares * logits.log_softmax(-1)).sum() / shares.sum().clamp(min=1.0)
