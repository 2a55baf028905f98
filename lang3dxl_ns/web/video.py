"""Videos of a flight along a tour, with the heat or the things of words and captions (ffmpeg)."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray as Array
from PIL import Image, ImageDraw

from lang3dxl_ns.common.captions import letters, lines
from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say, tracked
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.query.match import together
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt, parse_prompts
from lang3dxl_ns.scene.camera import Camera, Lens, check_pose, view_matrix
from lang3dxl_ns.things.find import Things, things_of, up_of
from lang3dxl_ns.things.outlines import outlined

RATE, SIZE = 25, (1280, 720)
"""Pictures per second, and their width and height in pixels."""
_FLIGHT, _PAUSE, _LETTER = 2.0, 3.0, 0.06
"""Seconds of a flight, at a stop, and for each letter of its caption."""
_MOST_STOPS, _MOST_CAPTION, _WIDEST, _STANDS = 1000, 300, 110.0, 1e-4
"""Most stops; and as in the page (tour.js, move.js): most letters of a caption, degrees of a lens that shows
as much to both sides as another window, and share of its distance within which an eye only turns."""
_LEFT_OUT = {
    **{"like": "words marked by example", "look": "lightings", "photo": "photos", "cameras": "cameras"},
    **{"hide": "hidden floaters", "hue": "chosen colors", "thing": "chosen things"},
}
"""What a stop may show and a film doesn't, by its name in the page's link."""
Shot = tuple[Camera, Mapping[Prompt, float | None], str, int]
"""A camera, the prompts whose heat is drawn with the thresholds chosen for them, a caption, and the number of
pictures that show it."""


def tour_shots(scene: Scene, tour: str, size: tuple[int, int] = SIZE) -> list[Shot]:
    """Plan a flight through the stops of a tour, which is written as in the page's link. Raises UserError if
    it has no stop, or is damaged."""
    shots, up, left_out = list[Shot](), up_of(scene), dict[str, None]()
    with readable("the scene's tour can't be read", "keep its views again in the page"):
        stops = [
            _stop(text, size, left_out) for name, text in parse_qsl(tour.removeprefix("#")) if name == "stop"
        ]
        expect(len(stops) <= _MOST_STOPS, f"it has {len(stops):,} stops")
        for (before, *_), (stand, prompts, caption) in zip([*stops[:1], *stops], stops, strict=False):
            times = np.linspace(0, 1, 1 + int(RATE * _FLIGHT))[1:] if shots else np.ones(1)
            for ease in times**2 * (3 - 2 * times):
                shots.append((_camera(_between(before, stand, ease), up, size), prompts, caption, 1))
            shots[-1] = (*shots[-1][:3], int(RATE * (_PAUSE + _LETTER * len(caption))))
    if not shots:
        raise UserError("there is no tour: keep views in the page of lang3dxl view")
    if left_out:
        say(f"The film leaves out what stops of the tour show besides: {', '.join(left_out)}")
    return shots


def _stop(
    text: str, size: tuple[int, int], left_out: dict[str, None]
) -> tuple[Float64[Array, "7"], dict[Prompt, float | None], str]:
    """Read a stop: position, point that is looked at and field of view in degrees; prompts with thresholds if
    chosen; caption. Adds to what is `left_out`."""
    fields, prompts = parse_qsl(text), dict[Prompt, float | None]()
    told, latest = dict(fields), list[Prompt]()
    for name, value in fields:
        if name in ("ask", "like"):
            latest = parse_prompts(value) if name == "ask" else []
            prompts |= dict.fromkeys(latest)
        elif name == "at" and 0 <= float(value) <= 1:
            prompts |= dict.fromkeys(latest, float(value))
        if name in _LEFT_OUT:
            left_out[_LEFT_OUT[name]] = None
    stand = np.array([float(number) for number in told["view"].split(",")]).reshape(7)
    expect(0 < stand[6] < 180, f"a view is {stand[6]} degrees wide")
    narrower = max(float(told.get("shape", 0)) * size[1] / size[0], 1)  # than the window of the stop
    wide = 2 * math.degrees(math.atan(narrower * math.tan(math.radians(stand[6]) / 2)))
    stand[6] = min(wide, max(_WIDEST, stand[6]))
    return stand, prompts, told.get("caption", "")[:_MOST_CAPTION]


def _between(before: Float64[Array, "7"], after: Float64[Array, "7"], share: float) -> Float64[Array, "7"]:
    """Fly around the point that is looked at rather than through it, as the page does (move.js)."""
    stand = before + share * (after - before)
    here, there = before[:3] - before[3:6], after[:3] - after[3:6]
    near, far = np.linalg.norm(here), np.linalg.norm(there)
    if min(near, far) > 0 and np.linalg.norm(after[:3] - before[:3]) >= _STANDS * near:
        way = (1 - share) * here / near + share * there / far
        way += 1e-6 * np.roll(here, 1) / near  # also to the opposite side
        stand[:3] = stand[3:6] + near ** (1 - share) * far**share * way / np.linalg.norm(way)
    return stand


def _camera(stand: Float64[Array, "7"], up: Float64[Array, "3"], size: tuple[int, int]) -> Camera:
    back = (stand[:3] - stand[3:6]) / max(np.linalg.norm(stand[:3] - stand[3:6]), 1e-9)
    right = np.cross(up + 1e-6 * np.roll(up, 1), back)  # also for a look straight down
    right /= np.linalg.norm(right)
    pose = np.vstack([np.stack([right, np.cross(back, right), back, stand[:3]], axis=1), [0, 0, 0, 1]])
    check_pose(pose.tolist())
    focal = size[1] / 2 / math.tan(math.radians(stand[6]) / 2)
    lens = Lens(*size, focal, focal, size[0] / 2, size[1] / 2)
    return lens.camera(view_matrix(torch.from_numpy(pose[:3]).float()))


def write_video(path: Path, scene: Scene, shots: Sequence[Shot], things: bool = False) -> int:
    """Write a video in the format that the name's ending tells, and return the number of pictures. things:
    draw numbered boxes of what prompts name in place of heat. Raises UserError without ffmpeg, if it can't
    write the file, and for things without a prompt."""
    if things and not any(prompts for _, prompts, *_ in shots):
        raise UserError("no stop of the tour has a word whose things could be shown: leave --things off")
    if shutil.which("ffmpeg") is None:
        raise UserError("a video needs ffmpeg: apt install ffmpeg, or conda install ffmpeg")
    first, path = shots[0][0], expanded(path).absolute()
    partial = path.with_name(f"{path.stem}.{os.getpid()}{path.suffix}")
    read = f"-f rawvideo -pix_fmt rgb24 -r {RATE} -s {first.width}x{first.height} -i -"
    even = "-vf pad=ceil(iw/2)*2:ceil(ih/2)*2 -pix_fmt yuv420p"  # which most players and codecs want
    command = ["ffmpeg", "-loglevel", "error", *read.split(), *even.split(), f"{partial}"]
    try:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            with suppress(BrokenPipeError):  # ffmpeg says why
                for picture in _pictures(scene, tracked(shots, "rendering"), things):
                    process.stdin.write(picture)  # type: ignore[union-attr]
            said = " ".join(process.communicate()[1].decode(errors="replace").split())
        if process.returncode:
            raise UserError(f"ffmpeg can't write {path} ({said[:200]}): choose another name, as out.mp4")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return sum(count for *_, count in shots)


def _pictures(scene: Scene, shots: Iterable[Shot], things: bool) -> Iterator[bytes]:
    """Render the shots, and yield the pixels of each picture."""
    asked, question, found = None, None, list[Things]()
    for camera, prompts, caption, count in shots:
        if prompts != asked:
            asked, question = prompts, scene.ask(list(prompts)) if prompts else None
            if question is not None:
                chosen = zip(prompts.values(), question.thresholds, strict=True)
                levels = tuple(own if level is None else level for level, own in chosen)
                question = replace(question, thresholds=levels)
            found = things_of(scene, question) if question is not None and things else []
        if question is None or things:
            pixels = outlined(scene.splats, found, scene.render(camera).rendering)
        else:
            pixels = together(scene.matches(question, camera))[: camera.height]  # without the legend
        picture = Image.fromarray(np.ascontiguousarray(pixels))
        if caption:
            font, pen = letters(camera.height / 24), ImageDraw.Draw(picture)
            place, text = (camera.width / 2, 0.96 * camera.height), lines(caption, font, 0.9 * camera.width)
            pen.text(place, text, font=font, anchor="md", align="center", stroke_width=2, stroke_fill="black")
        yield from [picture.tobytes()] * count
