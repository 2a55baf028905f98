"""Splat files of what matches a prompt."""

from __future__ import annotations

from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.files.splat_file import write_index, write_splats
from lang3dxl_ns.query.question import Question
from lang3dxl_ns.rendering import Splats


def write_matching(
    path: Path,
    splats: Splats,
    question: Question,
    everything: bool,
    index: str | Path | None,
    solid: Bool[Tensor, " n"] | None = None,
) -> int:
    """Write the Gaussians that match a question of one prompt, or all with their relevancy; see
    `Scene.export`. Of these, only `solid` ones are written, if given."""
    relevancy, keep = question.relevancy[0], question.gaussians[0]
    if solid is not None:
        keep = keep & solid
    if not everything and not keep.any():
        best, level = float(relevancy.max()), question.thresholds[0]
        raise UserError(
            f"no Gaussian matches {question.prompts[0].text!r}: the best reaches {best:.2f}; lower "
            f"--threshold, now {level:.2f}, or write all with their relevancy (--all)"
        )
    written = solid if everything else keep
    if written is not None:
        splats, relevancy = splats.select(written), relevancy[written]
    if index is not None:
        write_index(expanded(index), keep)
    return write_splats(path, splats, relevancy)
