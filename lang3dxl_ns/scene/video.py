"""The sharpest frames of a video, as photos."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy import ndimage

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import DAMAGE, UserError
from lang3dxl_ns.common.files import locked, own, read_json, replace_file
from lang3dxl_ns.scene.companions import cache_folder

VIDEO_SUFFIXES = (
    *(".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".3gp"),
)
_PER_SECOND, _MOST_FRAMES = 2.0, 300
"""Frames of each second, and of a whole video, at most: those of a long one are farther apart."""
_LOOK = (240, 135)  # pixels at which sharpness is judged; motion blur is visible there too
_COARSE = 15  # pixels of these that are averaged along each side to see change
_MOST_CHANGE = 95
"""Percentile of the changes between frames that larger ones are reduced to."""

_READING = ("-v", "error", "-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi,mpegts,mpeg")
"""Options of ffmpeg for untrusted files: a playlist, for example, could name other files and addresses."""
_HDR = ("arib-std-b67", "smpte2084")
"""What ffmpeg calls the transfer of HLG and PQ, as phones film unless told otherwise."""
_RESIZED = re.compile(r"w: (\d+) h: (\d+) fmt:[^,]*, incoming frame - w: (?!\1 h: \2 )(\d+) h: (\d+) ")
"""What ffmpeg warns of where a frame's size is not the first one's."""
_SILENT = subprocess.DEVNULL  # ffmpeg takes what is typed, or a script's own input, for commands


def _reading(program: str, video: Path) -> list[str]:
    # A name may look like an option, or like another protocol.
    return [program, *_READING, "-i", f"file:{video.absolute()}"]


def _each(filters: str) -> list[str]:
    """Return options of ffmpeg that write each frame that the filters leave once, without the combs of an
    interlaced one. (-fps_mode came in 5.1.)"""
    return ["-an", "-vf", f"yadif=deint=interlaced,{filters},settb=1/25,setpts=N", "-r", "25"]


def is_video(path: Path) -> bool:
    """Return whether this is a file that ffmpeg may be able to read as a video."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def frames_folder(video: Path) -> Path:
    """Return the folder of a video's frames, which is beside the video and named after it."""
    return video.with_name(f"{video.stem}_photos")


def extract_frames(video: Path) -> Path:
    """Write the sharpest frame of every half second to `frames_folder`/images, upright, unless an earlier
    call did. Raises UserError without ffmpeg, for a file that is no video or a very short one, and for a
    folder with the frames of another video."""
    folder = frames_folder(video)
    made_of = folder / "lang3dxl_cache" / "video.json"
    this = known = [video.name, video.stat().st_size] if video.is_file() else None
    if (folder / "images").is_dir():
        with suppress(*DAMAGE):  # frames of an earlier version have no such file
            known = read_json(made_of)
        if this is not None and known != this:
            raise UserError(f"{folder} holds frames of another video: rename {video.name}, or remove them")
        return folder
    if shutil.which("ffmpeg") is None or shutil.which("ffprobe") is None:
        raise UserError(
            f"{video} is a video, and ffmpeg isn't installed: install it (apt install ffmpeg, conda install "
            "ffmpeg), or give a folder of frames"
        )
    duration = _duration(video)
    stretches = max(1, min(_MOST_FRAMES, int(duration * _PER_SECOND + 0.01)))  # times are rounded
    say(f"{video.name}: {duration:.0f} s, the sharpest frame of each of {stretches} intervals")
    with locked(folder, busy=f"another command writes frames into {folder}: wait for it, or end it"):
        if (folder / "images").is_dir():  # another command has just written them
            return extract_frames(video)
        cache_folder(folder, None)  # a link is not written through
        sharpness, change = _looks(video)
        if len(sharpness) < 3:
            few = f"{len(sharpness)} frames, too few"
            raise UserError(f"{video} has {few}: record several seconds while moving")
        _write(video, folder, _sharpest(sharpness, change, min(stretches, len(sharpness))))
        replace_file(made_of, json.dumps(this))
    return folder


def _sharpest(sharpness: Float[Array, " n"], change: Float[Array, " n"], stretches: int) -> Int[Array, " s"]:
    """Return the index of the sharpest frame of each of `stretches` parts of a video. A part is long in time
    or in change: where somebody stands still, frames tell nothing new, and a turn needs many to overlap."""
    steps = change.clip(max=np.percentile(change, _MOST_CHANGE))  # a cut or a flash is no way
    gone = np.cumsum(steps) / max(steps.sum(), 1e-9) if steps.any() else np.arange(len(steps)) / len(steps)
    progress = (np.arange(len(steps)) / len(steps) + gone) / 2
    ends = np.searchsorted(progress, np.arange(1, stretches) / stretches - 1e-9)
    parts = [part for part in np.split(np.arange(len(steps)), ends) if len(part)]
    return np.array([part[sharpness[part].argmax()] for part in parts])


def _looks(video: Path) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Compute, for every frame, downsized and gray, the variance of its Laplacian and its difference from the
    frame before, which is coarse so that noise is none."""
    width, height = _LOOK
    program, *source = _reading("ffmpeg", video)
    # Where the picture changes its size, filters would begin anew, and frames after it would be others.
    command = [program, "-reinit_filter", "0", *source, *_each(f"scale={width}:{height}")]
    command += ["-v", "info", "-nostats", "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    values, changes, before = [], [], None
    with (
        TemporaryFile() as errors,
        subprocess.Popen(command, stdin=_SILENT, stdout=subprocess.PIPE, stderr=errors) as process,
    ):
        assert process.stdout is not None
        while len(frame := process.stdout.read(width * height)) == width * height:
            gray = np.frombuffer(frame, np.uint8).reshape(height, width).astype(np.float32)
            values.append(ndimage.laplace(gray).var())
            coarse = gray.reshape(height // _COARSE, _COARSE, width // _COARSE, _COARSE).mean((1, 3))
            changes.append(0.0 if before is None else float(np.abs(coarse - before).mean()))
            before = coarse
        failed = process.wait()
        errors.seek(0)
        said = " ".join(errors.read().decode(errors="replace").split())
    if failed:
        raise UserError(f"ffmpeg can't read {video} ({said[-200:]}): copy it again, or convert it")
    if sizes := _RESIZED.search(said):
        was, now = (f"{sizes[i]} x {sizes[i + 1]}" for i in (1, 3))
        raise UserError(f"{video} changes its size from {was} to {now} pixels: cut it there into two videos")
    return np.array(values), np.array(changes)


def _duration(video: Path) -> float:
    """Return a video's length in seconds: as it says, or from its frames' times where it does not."""
    found = _probed(video, "stream=codec_type,color_transfer:format=duration")
    if found["streams"][0].get("color_transfer") in _HDR:
        say(f"{video.name} is HDR, whose colors come out pale: for true ones, export it as SDR and give that")
    told = found.get("format", {}).get("duration")
    if told is not None:
        return float(told)
    # Browsers write the length nowhere: they begin a file before they know it.
    packets = _probed(video, "stream=codec_type:packet=pts_time").get("packets", [])
    times = sorted(float(packet["pts_time"]) for packet in packets if "pts_time" in packet)
    if not times:
        raise UserError(f"{video} does not tell the times of its frames: convert it (ffmpeg -i IN OUT.mp4)")
    return (times[-1] - times[0]) * len(times) / max(len(times) - 1, 1)


def _ran(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a program to its end. It repeats names and titles, which may be in any encoding."""
    return subprocess.run(
        command, stdin=_SILENT, capture_output=True, encoding="utf-8", errors="replace", check=False
    )


def _probed(video: Path, entries: str) -> dict[str, Any]:
    """Ask ffprobe about a video. Raises UserError for a file without a video that it reads."""
    asked = ("-select_streams", "v:0", "-show_entries", entries, "-of", "json")
    command = [*_reading("ffprobe", video), *asked]
    found = _ran(command)
    reason = " ".join(found.stderr.split())[-200:] or "it holds no pictures"
    with suppress(ValueError, KeyError):
        answer = json.loads(found.stdout)
        if answer["streams"]:
            return answer
    raise UserError(f"{video} is not a video that ffmpeg reads ({reason}): copy it again, or convert it")


def _write(video: Path, folder: Path, chosen: Int[Array, " s"]) -> None:
    """Write the chosen frames as JPEGs, all at once, so that a partial folder never looks complete."""
    partial = own(folder / ".images.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    wanted = "+".join(f"eq(n,{index})" for index in chosen)
    command = [*_reading("ffmpeg", video), *_each(f"select='{wanted}'")]
    command += ["-q:v", "2", str(partial).replace("%", "%%") + "/frame_%05d.jpg"]
    done = _ran(command)
    if done.returncode or not any(partial.iterdir()):
        said = " ".join(done.stderr.split())[-200:]
        raise UserError(f"ffmpeg can't write frames of {video} to {folder} ({said}): free space, or move it")
    partial.rename(folder / "images")
