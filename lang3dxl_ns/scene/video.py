"""Video frames as photos: the sharpest frame of every interval, extracted by ffmpeg."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy import ndimage

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts")
FRAMES_PER_SECOND = 2.0
MOST_FRAMES = 300
"""Maximum number of frames; the rate is reduced for a long video."""
_LOOK = (240, 135)  # pixels at which sharpness is judged; motion blur is visible there too

_READING = ("-v", "error", "-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi,mpegts,mpeg")
"""Options of ffmpeg for untrusted files: a playlist, for example, could name other files and addresses."""


def _reading(program: str, video: Path) -> list[str]:
    # A name may look like an option, or like another protocol.
    return [program, *_READING, "-i", f"file:{video.absolute()}"]


def is_video(path: Path) -> bool:
    """Return whether this is a file that ffmpeg may be able to read as a video."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def frames_folder(video: Path) -> Path:
    """Return the folder of a video's frames, which is beside the video and named after it."""
    return video.with_name(f"{video.stem}_photos")


def extract_frames(video: Path, rate: float = FRAMES_PER_SECOND, most: int = MOST_FRAMES) -> Path:
    """Write the sharpest frame of every interval of 1/`rate` seconds to `frames_folder`/images, upright,
    unless an earlier call did. Raises UserError without ffmpeg, and for a file that is no video or a very
    short one."""
    folder = frames_folder(video)
    if (folder / "images").is_dir():
        return folder
    if shutil.which("ffmpeg") is None or shutil.which("ffprobe") is None:
        raise UserError(
            f"{video} is a video, and ffmpeg isn't installed: install it (apt install ffmpeg, conda install "
            "ffmpeg), or give a folder of frames"
        )
    duration = _duration(video)
    stretches = max(1, min(most, int(duration * rate)))
    say(f"{video.name}: {duration:.0f} s, the sharpest frame of each of {stretches} intervals")
    sharpness = _sharpness(video)
    if len(sharpness) < 3:
        raise UserError(f"{video} has {len(sharpness)} frames: a scene needs a walk of some seconds")
    _write(video, folder, _sharpest(sharpness, min(stretches, len(sharpness))))
    return folder


def _sharpest(sharpness: Float[Array, " n"], stretches: int) -> Int[Array, " s"]:
    """Return the index of the largest value in each of `stretches` equal parts."""
    parts = np.array_split(np.arange(len(sharpness)), stretches)
    return np.array([part[sharpness[part].argmax()] for part in parts])


def _sharpness(video: Path) -> Float[Array, " n"]:
    """Compute the variance of the Laplacian of every frame, downsized and gray."""
    width, height = _LOOK
    command = [*_reading("ffmpeg", video), "-an", "-vf", f"scale={width}:{height}"]
    command += ["-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    values = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        while len(frame := process.stdout.read(width * height)) == width * height:
            gray = np.frombuffer(frame, np.uint8).reshape(height, width).astype(np.float32)
            values.append(ndimage.laplace(gray).var())
    return np.array(values)


def _duration(video: Path) -> float:
    asked = ("-select_streams", "v:0", "-show_entries", "stream=codec_type:format=duration", "-of", "json")
    command = [*_reading("ffprobe", video), *asked]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        answer = json.loads(found.stdout)
        if not answer["streams"]:
            raise KeyError("streams")
        return float(answer["format"]["duration"])
    except (ValueError, KeyError) as error:
        raise UserError(
            f"{video} is not a video that ffmpeg reads: {found.stderr.strip() or error}"
        ) from error


def _write(video: Path, folder: Path, chosen: Int[Array, " s"]) -> None:
    """Write the chosen frames as JPEGs, all at once, so that a partial folder never looks complete."""
    partial = folder / ".images.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    wanted = "+".join(f"eq(n,{index})" for index in chosen)
    command = [*_reading("ffmpeg", video), "-an", "-vf", f"select='{wanted}'"]
    command += ["-fps_mode", "passthrough", "-q:v", "2", str(partial / "frame_%05d.jpg")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode or not any(partial.iterdir()):
        raise UserError(f"ffmpeg can't write frames of {video} to {folder}: {done.stderr.strip()}")
    partial.rename(folder / "images")
