"""Photo pairs to match: all, or each photo with its most similar ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

EXHAUSTIVE = 200
"""Largest number of photos for which every pair is matched, which makes 19,900 pairs."""
NEIGHBORS = 40
"""Most similar photos with which each photo is paired in larger collections."""
_WORDS, _PER_WORD = 512, 32
"""Most visual words, and fewest features for each of them."""
_PER_PHOTO = 500
"""Features per photo that tell how it looks: the largest, which others see from afar too."""
_TEACHERS = 200  # photos from whose features the words are learned

Descriptors = Callable[[str], UInt8[Array, "n 128"]]
"""Function from a photo's name to the SIFT descriptors of its features, the largest first."""


def pairs_to_match(names: Sequence[str], descriptors: Descriptors) -> list[tuple[str, str]]:
    """List the pairs of photos that may overlap: all of them for up to `EXHAUSTIVE` photos. For more photos,
    the pairs are those of `similar_pairs`, and neighbors in name order, which is the order of a video or a
    walk."""
    if len(names) <= EXHAUSTIVE:
        return list(combinations(names, 2))
    found = set(similar_pairs(names, descriptors, NEIGHBORS))
    for apart in (1, 2, 4, 8):
        found.update(zip(names[:-apart], names[apart:], strict=True))
    return sorted(found)


def similar_pairs(names: Sequence[str], descriptors: Descriptors, neighbors: int) -> list[tuple[str, str]]:
    """Pair each photo with its `neighbors` nearest by aggregated descriptors (VLAD, Jégou et al. 2010)."""
    from sklearn.cluster import MiniBatchKMeans
    from sklearn.neighbors import NearestNeighbors

    some = np.random.default_rng(0).permutation(len(names))[:_TEACHERS]
    sample = np.concatenate([_rows(descriptors(names[i])) for i in some])
    count = max(min(_WORDS, len(sample) // _PER_WORD), 1)
    words = MiniBatchKMeans(count, random_state=0, n_init=3).fit(sample).cluster_centers_
    vectors = np.stack([_aggregate(_rows(descriptors(name)), words) for name in names])
    search = NearestNeighbors(n_neighbors=min(neighbors, len(names) - 1), metric="cosine").fit(vectors)
    found = enumerate(search.kneighbors(return_distance=False))  # without the photo itself
    return sorted({(names[min(i, j)], names[max(i, j)]) for i, others in found for j in others})


def _rows(descriptors: UInt8[Array, "n 128"]) -> Float[Array, "m 128"]:
    """Convert the descriptors of the largest features to RootSIFT."""
    rows = descriptors[:_PER_PHOTO].astype(np.float32)
    return np.sqrt(rows / np.maximum(rows.sum(1, keepdims=True), 1e-9))


def _aggregate(rows: Float[Array, "n 128"], words: Float[Array, "k 128"]) -> Float[Array, " d"]:
    """Sum the descriptors' differences from their nearest words, as roots, so that what repeats counts less,
    normalized per word and overall."""
    if not len(rows):
        return np.zeros(words.size, np.float32)
    nearest = (np.square(words).sum(1) - 2 * rows @ words.T).argmin(1)
    total = np.zeros_like(words)
    np.add.at(total, nearest, rows - words[nearest])
    total = np.sign(total) * np.sqrt(abs(total))
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    return (total / max(np.linalg.norm(total), 1e-9)).ravel()
