"""Rows of the ablation table: each is the method with one change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from lab.baselines import BASELINES
from lang3dxl_ns.common.errors import UserError

FULL, TEACHER, LIMIT, CHANCE = "full", "teacher", "limit", "chance"
FINE_TEACHER = "fine-teacher"
PAPER_METHOD = "lang3dxl-paper"
CLIPSEG, LANGSAM, SAM3 = "clipseg", "langsam", "sam3"
SEGMENTERS = (CLIPSEG, LANGSAM, SAM3)
"""Rows of networks that segment a picture by text."""
IN_PICTURES = (FINE_TEACHER, *SEGMENTERS)
"""Rows without training, which score a network on the test picture itself."""
BOUNDS = (TEACHER, LIMIT, CHANCE)
"""Rows whose figures every run of the full method records, with these prefixes."""
_FIELD, _DATA = "pipeline.model.semantic_field.", "pipeline.datamanager."
OF_TARGETS = ("scale_mode", "scale_range", "scales", "dense_tokens", "clip_features")
"""Data manager settings that change the content of targets. A row that sets one needs its own cache."""


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    name: str
    group: str
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Values by dotted path in the run's configuration."""
    method: str = "lang3dxl"
    """Name of the `ns-train` method."""
    published: str = ""
    """Lang3D-XL's published figures for the same comparison, on HolyScenes."""

    @property
    def trains(self) -> bool:
        """Whether the row needs its own training run."""
        return self.name not in (*BOUNDS, *IN_PICTURES)

    @property
    def own_targets(self) -> bool:
        """Whether the row's targets differ from those of other rows."""
        return any(path.removeprefix(_DATA) in OF_TARGETS for path in self.changes)


def _decoder(name: str, label: str, published: str = "") -> Row:
    return Row(name, "decoder", label, {"pipeline.model.decoder.name": name}, published=published)


_RATES = {
    "optimizers.field_decoder.optimizer.lr": 1e-4,
    "optimizers.field_decoder.optimizer.weight_decay": 0.0,
}
"""Rates of Feature 3DGS's layer in long runs, as published."""
_PAPER = {"pipeline.model.decoder.name": "paper"}
"""Changes of rows whose codes are trained with the scene, as in the row "paper", the one to compare with."""
ROWS = (
    Row(FULL, "method", "lang3dxl, the default"),
    Row(PAPER_METHOD, "method", "lang3dxl-paper, with regions of one color for SAM's",
        {f"{_DATA}regions": "felzenszwalb"}, PAPER_METHOD,
        published="mAP .59; windows AP .69; L1 .146, PSNR 13.9"),
    Row(f"{PAPER_METHOD}-noise", "method", "the same, its codes from noise, as published",
        {f"{_DATA}regions": "felzenszwalb", "pipeline.model.codes_from": "noise"}, PAPER_METHOD),
    Row(TEACHER, "2-D", "the crop pyramid itself, in the scored picture"),
    Row(FINE_TEACHER, "2-D", "what training photos are read as, in the scored picture"),
    Row(LIMIT, "2-D", "exact labels, lifted to the Gaussians and rendered back"),
    Row(CHANCE, "2-D", "a map without information"),
    Row(CLIPSEG, "2-D", "CLIPSeg", published="mAP .56"),
    Row(LANGSAM, "2-D", "LangSAM: GroundingDINO's boxes, masks by SAM", published="mAP .25"),
    Row(SAM3, "2-D", "SAM 3: masks of what a text names"),
    Row("feature3dgs", "decoder", "Feature 3DGS: wide codes, linear layer",
        {"pipeline.model.decoder.name": "feature3dgs"} | _RATES, published="L1 .149, PSNR 13.3"),
    _decoder("fmgs", "FMGS: hash grid over places, whole features rendered", "mAP .51; L1 .180, PSNR 11.6"),
    _decoder("langsplat", "LangSplat: per-scene autoencoder to 3 numbers", "mAP .19"),
    _decoder("direct", "whole feature on every Gaussian"),
    _decoder("lifting", "training-free lifting"),
    _decoder("paper", "as published: codes composited, then decoded"),
    Row("hash", "field", "hash grid alone", {f"{_FIELD}fourier_frequencies": 0}),
    Row("fourier", "field", "Fourier features alone",
        {f"{_FIELD}levels": 0, f"{_FIELD}fourier_frequencies": 4}),
    Row("both", "field", "hash grid and Fourier features", {f"{_FIELD}fourier_frequencies": 4}),
    Row("field-paper", "field", "preset paper", {f"{_FIELD}preset": "paper"}),
    Row("field-official", "field", "preset official", {f"{_FIELD}preset": "official"}),
    Row("code-2", "field", "codes of 2 numbers", {f"{_FIELD}code_dim": 2}),
    Row("code-4", "field", "codes of 4 numbers", {f"{_FIELD}code_dim": 4}),
    Row("code-6", "field", "codes of 6 numbers", {f"{_FIELD}code_dim": 6}),
    Row("lerf", "supervision", "LERF's pyramid instead of physical scales",
        {f"{_DATA}scale_mode": "relative"}, published="windows AP .64"),
    Row("single-scale", "supervision", "crops of one size", {f"{_DATA}scales": 1}),
    Row("pyramid", "supervision", "gathered from the whole pyramid, crops half a side apart",
        {f"{_DATA}crops": "pyramid"}),
    Row("crops", "supervision", "crops alone, sharpened by dense features, as with other CLIPs",
        {f"{_DATA}clip_features": "crops", f"{_DATA}dense": "builtin"}),
    Row("unsharpened", "supervision", "crops alone, not sharpened",
        {f"{_DATA}clip_features": "crops", f"{_DATA}dense": "none"}),
    Row("sharpened", "supervision", "the default's features, sharpened by dense ones",
        {f"{_DATA}dense": "builtin"}),
    Row("no-ad-lr", "supervision", "without attenuated downsampler (LR)",
        _PAPER | {"pipeline.model.downsampler.match": "resize-features"}, published="windows AP .53"),
    Row("no-ad-hr", "supervision", "without attenuated downsampler (HR)",
        _PAPER | {"pipeline.model.downsampler.match": "resize-target"}, published="windows AP .46"),
    Row("box", "supervision", "box window instead of the pyramid kernel",
        _PAPER | {"pipeline.model.downsampler.kernel": "box"}),
    Row("no-dense", "supervision", "without dense features",
        _PAPER | {f"{_DATA}dense": "none"}, published="windows AP .30"),
    Row("no-regions", "supervision", "without regions",
        _PAPER | {f"{_DATA}regions": "none"}, published="windows AP .60"),
    Row("regions", "supervision", "with regions (felzenszwalb)",
        _PAPER | {f"{_DATA}regions": "felzenszwalb"}),
    Row("no-decay", "supervision", "without weight decay",
        _PAPER | {f"optimizers.{g}.optimizer.weight_decay": 0.0 for g in ("field_decoder", "downsampler")}),
)  # fmt: skip
"""All available rows."""
SYSTEMS = (FULL, "paper", *BASELINES, *BOUNDS)
"""Rows of the group "systems": the feature decoders, and the bounds to compare them with."""


def choose_rows(names: Iterable[str], short_run: bool, has_regions: bool) -> list[Row]:
    """Choose the rows with these names ("systems": `SYSTEMS`), in the order of `ROWS`; by default all but the
    paper's method and rows that equal another.

    The full method has Fourier features in short runs only, and the row "paper" has regions only if the scene
    has a folder of them. Raises UserError for an unknown name.
    """
    known = {row.name for row in ROWS}
    names = {part for name in names for part in (SYSTEMS if name == "systems" else (name,))}
    if unknown := [name for name in names if name not in known]:
        choices = ", ".join(row.name for row in ROWS)
        raise UserError(f"there is no row {', '.join(unknown)}: choose of systems, {choices}")
    same = {"both" if short_run else "hash", "regions" if has_regions else "no-regions"}
    # The paper's method takes ten times as long on a CPU, so it runs only on request.
    wanted = set(names) or {row.name for row in ROWS if row.method != PAPER_METHOD} - same
    return [row for row in ROWS if row.name in wanted]
