"""`lang3dxl benchmark gpu`: parity, numerics, time and memory on a GPU, in one Markdown file."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lab.reports import command_line
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.common.image import fitted_size
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report
from lang3dxl_ns.components.appearance import AppearanceConfig, AppearanceField
from lang3dxl_ns.components.compression import CompressedField, centered_cosine
from lang3dxl_ns.components.feature_decoder import Gathered
from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig
from lang3dxl_ns.components.losses import rgb_loss
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.components.semantic_field import SemanticField
from lang3dxl_ns.query.engine import PerGaussian
from lang3dxl_ns.rendering import Gaussians, rasterize
from lang3dxl_ns.rendering.gathering import Pixels, gather
from lang3dxl_ns.rendering.rasterize import at_fewer_pixels
from lang3dxl_ns.scene.camera import Camera

CLIP = 512
"""Channels of the features whose cost is measured."""
_TABLES = {
    "step": "Training step, milliseconds: colors alone; `paper` also decodes codes, `looks` a photo's look",
    "words": f"Words, from a CLIP of {CLIP} channels",
    "encoder": "Crops that a CLIP encodes per second",
    "reading": "Photos of 12 MP that one reader decodes per second",
    "frame": "Frame with heat maps of some prompts, milliseconds",
    "parity": "Difference of gsplat from torch",
}
"""Headings of the parts, by the beginning of their names."""


@dataclass
class GpuBenchmark:
    """Measure what only a GPU can show, in about ten minutes; finished parts are kept in case it is stopped.

    The Gaussians are random ones in front of the camera, with view-independent colors. Encoders have random
    weights in the sizes of real ones.
    """

    out: Path
    """Folder for gpu.md, gpu.json and the finished parts."""
    quick: bool = False
    """Small sizes, to try the command."""

    def main(self) -> None:
        if not torch.cuda.is_available():
            raise UserError("torch sees no GPU here: lang3dxl doctor says why")
        sizes = (200, 400) if self.quick else (100_000, 300_000, 1_000_000)
        frame = (48, 32) if self.quick else (1920, 1080)
        photo = (48, 32) if self.quick else (1000, 700)
        parts: dict[str, Callable[[], Any]] = {
            "parity": lambda: parity(300 if self.quick else 20_000, photo),
            "numerics": lambda: numerics(self.quick),
            **{f"step-{n}": lambda n=n: step(n, photo) for n in sizes},  # type: ignore[misc]
            "step-paper": lambda: step(sizes[0], photo, paper=True),
            "step-looks": lambda: step(sizes[0], photo, looks=True),
            **{f"words-{n}": lambda n=n: words(n, photo, 5 if self.quick else 1_000) for n in sizes},  # type: ignore[misc]
            "encoder": lambda: encoder(self.quick),
            "reading": lambda: reading((48, 32) if self.quick else (4000, 3000)),
            **{f"frame-{q}": lambda q=q: still(sizes[-1], frame, q) for q in (0, 1, 4)},  # type: ignore[misc]
        }
        results = {name: self._kept(name, work) for name, work in parts.items()}
        machine, command = describe_machine("cuda"), command_line("lang3dxl benchmark gpu", self)
        data = {"machine": machine, "command": command, "results": results}
        write_report(self.out, "gpu", _markdown(results, machine, command), data)
        print(f"Wrote {self.out / 'gpu.md'}")

    def _kept(self, name: str, work: Callable[[], Any]) -> Any:
        """The part's result: from an earlier run, if it got that far."""
        path = self.out / "parts" / f"{name}.json"
        if not path.is_file():
            print(f"measuring {name}", flush=True)
            write_atomically(path, json.dumps(work()))
        return json.loads(path.read_text())


def cloud(count: int, size: tuple[int, int]) -> tuple[dict[str, Tensor], Camera]:
    """Parameters of random Gaussians (as trained: logarithms, logits), and a camera that sees them; on the
    GPU. size: width and height, pixels."""
    draw = torch.Generator().manual_seed(0)
    raw = {
        "means": torch.rand(count, 3, generator=draw) * 4 - torch.tensor([2.0, 2.0, -3.0]),
        "quats": torch.randn(count, 4, generator=draw),
        "scales": torch.rand(count, 3, generator=draw) - 3.5 - torch.tensor(float(count)).log() / 6,
        "opacities": torch.randn(count, generator=draw),
        "colors": torch.randn(count, 3, generator=draw),
    }
    width, height = size
    lens = torch.tensor([[0.9 * width, 0.0, width / 2], [0.0, 0.9 * width, height / 2], [0.0, 0.0, 1.0]])
    return {name: value.cuda() for name, value in raw.items()}, Camera(torch.eye(4), lens, width, height)


def _gaussians(raw: dict[str, Tensor]) -> Gaussians:
    return Gaussians(raw["means"], raw["quats"], raw["scales"].exp(), raw["opacities"].sigmoid())


def parity(count: int, size: tuple[int, int]) -> dict[str, float]:
    """Largest and mean difference of both rasterizers' pictures, and relative ones of their gradients."""
    found = {}
    for backend in ("torch", "gsplat"):
        raw, camera = cloud(count, size)
        for value in raw.values():
            value.requires_grad_(True)
        image = rasterize(_gaussians(raw), camera, raw["colors"].sigmoid(), backend=backend).image  # type: ignore[arg-type]
        slopes = torch.autograd.grad((image - 0.5).square().sum(), list(raw.values()))
        found[backend] = (image.detach(), dict(zip(raw, slopes, strict=True)))
    (image, gradients), (other, others) = found["torch"], found["gsplat"]
    off = (image - other).abs()
    errors = {"image, largest": off.max(), "image, mean": off.mean()}
    for name, gradient in gradients.items():
        errors[f"gradient of {name}"] = (gradient - others[name]).norm() / gradient.norm()
    return {name: float(value) for name, value in errors.items()}


def numerics(quick: bool) -> dict[str, Any]:
    """How many hard cases are within their bounds (tf32 among them), and those that are not."""
    from lab.numerics import decoder, losses
    from lab.numerics.catalog import all_cases
    from lab.numerics.command import measure_all

    cases = list(losses.cases(True, "cuda"))[:2] + list(decoder.cases(True, "cuda"))[:1]
    rows = measure_all(cases if quick else list(all_cases(True, "cuda")), quick, "cuda")
    missed = [row.name for row in rows if row.misses]
    return {"rows": len(rows), "missed": missed}


def step(count: int, size: tuple[int, int], paper: bool = False, looks: bool = False) -> dict[str, float]:
    """Milliseconds of a training step by part, and the peak of its memory, GB.

    paper: with codes, which the published field decodes at 120 pixels. looks: with colors that depend on a
    photo.
    """
    raw, camera = cloud(count, size)
    if paper:
        raw["codes"] = torch.zeros(count, 3).cuda()
    parameters = {name: torch.nn.Parameter(value) for name, value in raw.items()}
    field = SemanticField(SemanticFieldConfig("paper"), CLIP).cuda()
    look = AppearanceField(AppearanceConfig(), ["photo"], raw["means"].mean(0).cpu(), 3.0).cuda()
    networks = [*(field.parameters() if paper else ()), *(look.parameters() if looks else ())]
    optimizer = torch.optim.Adam([*parameters.values(), *networks], lr=1e-4)
    draw = torch.Generator().manual_seed(1)
    target = torch.rand(size[1], size[0], 3, generator=draw).cuda()
    small = fitted_size(target.shape, 120)
    wanted = torch.randn(*small, CLIP, generator=draw).cuda()
    state: dict[str, Any] = {}

    def render() -> None:
        optimizer.zero_grad()
        gaussians, colors = _gaussians(parameters), parameters["colors"].sigmoid()  # type: ignore[arg-type]
        if looks:
            everything = torch.arange(count, device=colors.device)
            colors, gaussians = look(gaussians, colors, look.vector("photo"), everything, 0)
        state["photo"] = rasterize(gaussians, camera, colors).image
        if paper:
            view, eps2d = at_fewer_pixels(camera, *small)
            state["codes"] = rasterize(gaussians, view, parameters["codes"], eps2d=eps2d).image

    def loss() -> None:
        state["loss"] = rgb_loss(state["photo"], target)
        if paper:
            state["loss"] = state["loss"] + (field.decode_clip(state["codes"]) - wanted).abs().mean()

    work = {"render": render, "loss": loss, "backward": lambda: state["loss"].backward()}
    torch.cuda.reset_peak_memory_stats()
    seconds = times_of_parts({**work, "optimizer": lambda: optimizer.step()})
    found = {name: 1e3 * value for name, value in seconds.items()}
    return found | {"step": sum(found.values()), "memory (GB)": torch.cuda.max_memory_allocated() / 1e9}


def words(count: int, size: tuple[int, int], steps: int) -> dict[str, float]:
    """What semantics of 512 channels cost: milliseconds to gather a photo and to ask a text, seconds to
    compress, and the peak of memory, GB."""
    raw, camera = cloud(count, size)
    gaussians, draw = _gaussians(raw), torch.Generator().manual_seed(2)
    axes, _ = torch.linalg.qr(torch.randn(CLIP, CompressedField.gathered_channels, generator=draw))
    basis = PrincipalBasis(torch.zeros(CLIP), axes)
    pixels = Pixels.of([torch.rand(40, 60, axes.shape[1], generator=draw).cuda()], (size[1], size[0]))
    views = [(lambda carried: rasterize(gaussians, camera, carried).image, pixels)]
    torch.cuda.reset_peak_memory_stats()
    photo = lambda: gather(count, views, axes.shape[1], raw["means"])  # noqa: E731
    seconds = {"gather": median_seconds(photo, repeats=3)}
    features, mass = photo()
    # Random pixels have no kinds of things, so that features of 100 kinds are compressed instead. As in
    # trained scenes, eight principal components hold 96 % of their variance.
    spread = (0.82 ** torch.arange(features.shape[1])).to(features)
    kinds = torch.randn(100, features.shape[1], generator=draw).to(features)
    kinds = kinds[torch.arange(count, device=features.device) % 100]
    features = spread * (kinds + 0.15 * torch.randn_like(features))
    field = CompressedField(SemanticFieldConfig("short"), CLIP, CompressionConfig(steps=steps)).cuda()
    torch.cuda.synchronize()
    start = time.perf_counter()
    codes = field.learn_gaussians(Gathered(features, mass, basis))
    torch.cuda.synchronize()
    seconds["compress"] = time.perf_counter() - start
    known = mass > 0
    cosine = centered_cosine(Gathered(features, mass, basis)[known], field, codes[known.to(codes.device)])
    rows = PerGaussian.of(field, codes)
    text = torch.nn.functional.normalize(torch.randn(CLIP, 1, generator=draw), dim=0).cuda()
    ask = lambda: rows.rows.float() @ (text if rows.head is None else rows.head @ text)  # noqa: E731
    seconds["ask"] = median_seconds(ask)
    return {
        "gather a photo (ms)": 1e3 * seconds["gather"],
        "compress (s)": seconds["compress"],
        "centered cosine": cosine,
        "ask a text (ms)": 1e3 * seconds["ask"],
        "memory (GB)": torch.cuda.max_memory_allocated() / 1e9,
    }


def encoder(quick: bool) -> dict[str, float]:
    """Crops per second of a CLIP of the size of ViT-B/32 and of ViT-L/14, in half precision."""
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    sizes = {"B/32": (768, 12, 12, 32), "L/14": (1024, 24, 16, 14)}
    found, batch = {}, 2 if quick else 256
    for name, (width, layers, heads, patch) in sizes.items():
        config = CLIPVisionConfig(
            hidden_size=32 if quick else width, intermediate_size=64 if quick else 4 * width,
            num_hidden_layers=1 if quick else layers, num_attention_heads=2 if quick else heads,
            patch_size=patch, image_size=224, projection_dim=CLIP,
        )  # fmt: skip
        model = CLIPVisionModelWithProjection(config).eval().to("cuda")
        crops = torch.zeros(batch, 3, 224, 224).cuda()

        def encode(model=model, crops=crops) -> None:
            with torch.no_grad(), torch.autocast("cuda", torch.float16):
                model(pixel_values=crops)

        found[name] = batch / median_seconds(encode, repeats=3)
    return found


def reading(size: tuple[int, int]) -> dict[str, float]:
    """Photos of a size that one reader decodes per second, and copies to the GPU."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "photo.jpg"
        draw = torch.randint(0, 256, (size[1] // 8, size[0] // 8, 3), dtype=torch.uint8)
        Image.fromarray(draw.numpy()).resize(size).save(path, quality=90)

        def read() -> None:
            torch.from_numpy(np.array(Image.open(path).convert("RGB"))).to("cuda")

        return {"photos": 1 / median_seconds(read, repeats=3)}


def times_of_parts(parts: dict[str, Callable[[], object]], repeats: int = 20) -> dict[str, float]:
    """Median seconds of each part of a step; the first three steps are warm-up."""
    times: dict[str, list[float]] = {name: [] for name in parts}
    for number in range(repeats + 3):
        for name, work in parts.items():
            torch.cuda.synchronize()
            start = time.perf_counter()
            work()
            torch.cuda.synchronize()
            if number >= 3:
                times[name].append(time.perf_counter() - start)
    return {name: median(found) for name, found in times.items()}


def median_seconds(work: Callable[[], object], repeats: int = 20) -> float:
    """Median seconds of one piece of work; see `times_of_parts`."""
    return times_of_parts({"work": work}, repeats)["work"]


@torch.no_grad()
def still(count: int, size: tuple[int, int], prompts: int) -> dict[str, float]:
    """Milliseconds of a frame with heat maps of some prompts, and the peak of its memory, GB."""
    raw, camera = cloud(count, size)
    torch.cuda.reset_peak_memory_stats()
    gaussians, colors = _gaussians(raw), raw["colors"].sigmoid()
    carried = torch.cat([colors, colors[:, :1].expand(-1, prompts)], dim=1)
    frame = lambda: rasterize(gaussians, camera, carried, render_depth=True)  # noqa: E731
    seconds = median_seconds(frame)
    return {"frame": 1e3 * seconds, "memory (GB)": torch.cuda.max_memory_allocated() / 1e9}


def _markdown(results: dict[str, Any], machine: str, command: str) -> str:
    sections = []
    for kind, title in _TABLES.items():
        own = {
            name.removeprefix(f"{kind}-"): found for name, found in results.items() if name.startswith(kind)
        }
        columns = next(iter(own.values()))
        rows = [[name, *(f"{value:.4g}" for value in found.values())] for name, found in own.items()]
        sections.append(f"## {title}\n\n{markdown_table(['', *columns], rows)}")
    measured, missed = results["numerics"]["rows"], results["numerics"]["missed"]
    fine = f"{measured - len(missed)} of {measured} hard cases are within their bounds."
    numerics = "\n".join(["## Numerics", "", fine, *(f"- {name}" for name in missed)])
    return "\n\n".join(["# On a GPU", f"`{command}`\n{machine}.", *sections, numerics])
