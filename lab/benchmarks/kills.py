"""Commands killed at random times: nothing is lost, and the same command goes on to the same end.

PYTHONPATH=tests python -m lab.benchmarks.kills --out DIR --kills 150
"""

from __future__ import annotations

import hashlib
import json
import random
import re
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import processes
import scenes
import torch
import tyro
from safetensors import safe_open
from tiny_models import make_tiny_clip

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.scene_file import describe_scene_file, read_scene
from lang3dxl_ns.scene.colmap import read_reconstruction

SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
TAUGHT, CLIP = "gizmo", ("--clip", "../clip", "--dense", "none")
TEACH = ("--photo", "photo_000.jpg", "--box", "20,20,60,50")
WHOLE = r"sparse already exists and is left alone|already has \d+\s+iterations|no photos that the model lacks"
"""What commands say, as errors, if a kill came after all of their work."""
Told = list[str]


@dataclass
class Case:
    """A command, and what has to be true after each kill and at its end."""

    words: tuple[str, ...]
    ended: Callable[[Path], str]
    """Raises an exception unless the work in the folder is whole; returns what all runs must agree in."""
    keeps: str | None = None
    """Scene file that has to open, and to know the word taught earlier, at any moment."""
    resumed: Callable[[Path], tuple[str, ...]] = lambda _: ()
    """Further words with which a user goes on."""
    changes: tuple[str, ...] = ()
    """Beginnings of files of the user that the command may change, besides the scene."""
    serves: str | None = None
    """What it says once it serves, after which Ctrl-C is its end."""


@dataclass
class Kills:
    """Kill commands on tiny scenes at random times by SIGKILL, SIGINT and SIGTERM."""

    out: Path
    """Folder to work in, which is emptied; report.json is written there."""
    kills: int = 150
    seed: int = 0
    only: tuple[str, ...] = ()
    """Names of the commands; default: all."""

    def main(self) -> None:
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.mkdir(parents=True)
        out, draw = self.out.absolute(), random.Random(self.seed)
        signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start background jobs without it
        processes.start_server()
        stock(out)
        cases = {name: case for name, case in CASES.items() if not self.only or name in self.only}
        lengths, right = dict[str, float](), dict[str, str]()
        for name, case in cases.items():
            begin, folder = time.time(), fresh(out, name)
            done = finished(case, folder)
            assert done.returncode == 0, done.stdout + done.stderr
            lengths[name], right[name] = time.time() - begin, case.ended(folder)
            print(f"{name}: {lengths[name]:.1f} s undisturbed", flush=True)
        counts, faults = Counter[str](), list[str]()
        while sum(counts.values()) < self.kills:
            for name, case in cases.items():
                found = trial(out, name, case, lengths[name], right[name], draw, counts)
                faults += [f"{name}: {fault}" for fault in found]
                print(f"{name}: {sum(counts.values())} kills, {found or 'right'}", flush=True)
                report = {"kills": sum(counts.values()), "by": counts, "faults": faults}
                (out / "report.json").write_text(json.dumps(report, indent=1))


def trial(
    out: Path, name: str, case: Case, length: float, right: str, draw: random.Random, counts: Counter[str]
) -> Told:
    """Kill a command three times, let it end, and return what is wrong."""
    folder, faults = fresh(out, name), Told()
    given = prints(folder)
    for _ in range(3):
        number, moment = draw.choice(SIGNALS), draw.uniform(0.2, length)
        process = processes.start(*case.words, *case.resumed(folder), cwd=folder, new_session=True)
        time.sleep(moment)
        ended = process.poll() is not None
        if not ended:
            process.send_signal(number)
        try:
            done = process.wait(180)
        except TimeoutError as error:
            faults.append(f"{number.name} at {moment:.1f} s does not end it: {str(error)[-500:]}")
            continue
        if ended:
            break
        counts[f"{name} {number.name}"] += 1
        said = done.stdout + done.stderr
        if re.search(WHOLE, said):
            break
        stopped = done.returncode in (0, 130, 143, -2, -15) or number is signal.SIGKILL
        if "Traceback" in said or not stopped:
            faults.append(f"{number.name} at {moment:.1f} s: ends with {done.returncode}: {said[-1500:]}")
        faults += [f"{number.name} at {moment:.1f} s: {what}" for what in lost(folder, given, case)]
    done = finished(case, folder)
    try:
        if done.returncode and not re.search(WHOLE, said := done.stdout + done.stderr):
            raise RuntimeError(said[-1500:])
        if (end := case.ended(folder)) != right:
            faults.append(f"another end: {end}, not {right}")
    except Exception as error:
        faults.append(f"does not go on: {type(error).__name__}: {error}")
    faults += [f"at the end: {what}" for what in lost(folder, given, case)]
    if faults:
        shutil.copytree(folder, out / f"fault-{name}-{sum(counts.values())}", symlinks=True)
    return faults


def finished(case: Case, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command to its end. One that serves is ended by Ctrl-C once it does."""
    process = processes.start(*case.words, *case.resumed(folder), cwd=folder, new_session=True)
    said = ""
    while case.serves and case.serves not in said and process.poll() is None:
        time.sleep(0.1)
        with suppress(FileNotFoundError):  # it has only just begun
            said = process.stdout
    if case.serves:
        process.send_signal(signal.SIGINT)
    return process.wait(300)


def lost(folder: Path, given: dict[str, str], case: Case) -> Told:
    """List what is no longer as it was. A scene that may change has to open and to know its word."""
    now = prints(folder)
    may_change = tuple(filter(None, (case.keeps, *case.changes)))
    told = [f"{n} changed" for n in given if not n.startswith(may_change) and now.get(n) != given[n]]
    if case.keeps:
        try:
            words = {word.name for word in describe_scene_file(folder / case.keeps)["taught"]}
            told += [] if TAUGHT in words else [f"{case.keeps} knows {sorted(words)}"]
            read_scene(folder / case.keeps, "cpu")
        except UserError as error:
            told.append(str(error))
    return told


def prints(folder: Path) -> dict[str, str]:
    """Compute the hashes of all files of a user: not ours, which a command may replace."""
    ours = ("lang3dxl_cache", "outputs", "run", "page")
    files = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
    own = [path for path in files if not {*path.relative_to(folder).parts} & {*ours}]
    return {str(path.relative_to(folder)): digest(path) for path in own}


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


# ── what commands work on ───────────────────────────────────────────────────────────────────────────────


def stock(out: Path) -> None:
    """Make what the commands need: photos with a model, photos alone, a scene with a taught word, a splat."""
    make_tiny_clip(out / "clip")
    base = out / "stock"
    scenes.write_scene(base / "data", photos=8, points=120)
    scenes.texture = scenes.speckled
    scenes.write_scene(base / "photos", photos=6, size=(240, 180))
    shutil.copytree(base / "photos", base / "more")
    shutil.rmtree(base / "photos" / "sparse")
    (base / "late").mkdir()
    for name in ("photo_001.jpg", "photo_004.jpg"):
        shutil.move(base / "more" / "images" / name, base / "late" / name)
    shutil.rmtree(base / "more" / "sparse")
    (base / "path.json").write_text(json.dumps(PATH))
    short = ("--out", "run", "--steps", "12", *CLIP)
    for words in (
        ("train", "data", *short),
        ("export", "run", "--scene-file", "castle.scene"),
        ("export", "run", "--out", "splat.ply"),
        ("teach", "castle.scene", "--word", TAUGHT, *TEACH),
        ("export", "run", "--web", "page"),
        ("reconstruct", "--data", "more"),
    ):
        processes.output("lang3dxl", *words, cwd=base)
    shutil.rmtree(base / "run")
    for cache in base.glob("*/lang3dxl_cache"):
        if cache.parent.name != "more":
            shutil.rmtree(cache)


def fresh(out: Path, name: str) -> Path:
    """Copy the stock for a command."""
    folder = out / f"work-{name}"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(out / "stock", folder)
    return folder


# ── what is right at the end ────────────────────────────────────────────────────────────────────────────


def scene_in(pattern: str, folder: Path, *known: str) -> str:
    """Open a scene; return a hash of its Gaussians and codes."""
    (path,) = folder.glob(pattern)
    scene = read_scene(path, "cpu")
    assert {*known} <= scene.words.keys(), f"{path} knows {scene.words.keys()}"
    with safe_open(path, "np") as file:
        tensors = [file.get_tensor(name).tobytes() for name in sorted(file.keys()) if name[:4] != "mask"]
    return hashlib.sha256(b"".join(tensors)).hexdigest()[:12]


def page(folder: Path) -> str:
    """Check that a page has the files that it names, with the contents that their names tell."""
    named = json.loads((folder / "page" / "scene.json").read_text())["files"]
    for name in named.values():
        assert name.split(".")[1] == hashlib.sha256((folder / "page" / name).read_bytes()).hexdigest()[:12]
    data = {path.name for path in (folder / "page").iterdir()} & {*named.values()}
    return f"{len(data)} files, {named['splats.bin']}"


def model(name: str, folder: Path) -> str:
    found = read_reconstruction(folder / name / "sparse" / "0")
    return f"{len(found.photos)} photos"


def video(folder: Path) -> str:
    """Count the pictures of a video that ffmpeg reads to its end."""
    asked = ("-count_frames", "-show_entries", "stream=nb_read_frames", "-of", "csv=p=0")
    return subprocess.check_output(["ffprobe", "-v", "error", *asked, str(folder / "out.mp4")], text=True)


def things(folder: Path) -> str:
    return digest(folder / "things" / "things.json")


def targets(folder: Path) -> str:
    from lang3dxl_ns.preparation.store import FeatureStore

    store, found = FeatureStore(folder / "data" / "lang3dxl_cache"), []
    for kind in sorted(store.sizes()):
        for name in sorted(path.name for path in (folder / "data" / "images").iterdir()):
            if store.path(kind, name).exists():  # held-out photos have none
                values = store.read(kind, name)
                sums = sorted((key, float(value.float().sum())) for key, value in values.items())
                found.append((kind, name, sums))
    assert found
    return hashlib.sha256(json.dumps(found).encode()).hexdigest()[:12]


def newest_checkpoint(folder: Path) -> tuple[str, ...]:
    """How one goes on with a run of ns-train: from its newest checkpoint, if it has one."""
    found = sorted(folder.glob("outputs/**/nerfstudio_models/*.ckpt"), key=lambda path: path.stat().st_mtime)
    return ("--load-dir", str(found[-1].parent)) if found else ()


def newest_scene(folder: Path) -> str:
    path = max(folder.glob("outputs/**/*.scene"), key=lambda path: path.stat().st_mtime)
    return f"{len(read_scene(path, 'cpu').splats)} Gaussians"


def exported(folder: Path) -> str:
    from lang3dxl_ns.files.read_splats import read_splats

    return str(float(read_splats(folder / "new.ply").means.sum()))


_POSE = [1, 0, 0, 0, 0, 0, -1, -4, 0, 1, 0, 0.5, 0, 0, 0, 1]
_FRAME = {"camera_to_world": _POSE, "fov": 50}
PATH = {"render_width": 320, "render_height": 240, "camera_path": [_FRAME] * 40}
_NS = ("ns-train", "lang3dxl", "--data", "data", "--max-num-iterations", "24", "--steps-per-save", "6")
CASES = {
    "train": Case(
        ("lang3dxl", "train", "data", "--out", "run", "--steps", "24", "--save-every", "6", *CLIP),
        partial(scene_in, "run/*.scene"),
    ),
    "ns-train": Case(
        (*_NS, "--vis", "tensorboard", *(word.replace("--", "--pipeline.datamanager.") for word in CLIP)),
        newest_scene,
        resumed=newest_checkpoint,
    ),
    "attach": Case(
        ("lang3dxl", "attach", "splat.ply", "--data", "data", "--out", "castle.scene", *CLIP),
        lambda folder: scene_in("castle.scene", folder, TAUGHT),
        keeps="castle.scene",
    ),
    "teach": Case(
        ("lang3dxl", "teach", "castle.scene", "--word", "door", *TEACH),
        lambda folder: scene_in("castle.scene", folder, TAUGHT, "door"),
        keeps="castle.scene",
    ),
    "export-page": Case(("lang3dxl", "export", "castle.scene", "--web", "page"), page, "castle.scene"),
    "export-scene": Case(
        ("lang3dxl", "export", "castle.scene", "--scene-file", "copy.scene"),
        lambda folder: scene_in("copy.scene", folder, TAUGHT),
        keeps="castle.scene",
    ),
    "export-splat": Case(
        ("lang3dxl", "export", "castle.scene", "--out", "new.ply"), exported, keeps="castle.scene"
    ),
    "reconstruct": Case(("lang3dxl", "reconstruct", "--data", "photos"), partial(model, "photos")),
    "add": Case(
        ("lang3dxl", "reconstruct", "--data", "more", "--add", "late"),
        partial(model, "more"),
        changes=("more/sparse/0/",),
    ),
    "things": Case(
        ("lang3dxl", "things", "castle.scene", "--text", TAUGHT, "--out", "things"), things, "castle.scene"
    ),
    "video": Case(
        ("lang3dxl", "export", "castle.scene", "--video", "out.mp4", "--camera-path", "path.json"),
        video,
        keeps="castle.scene",
    ),
    "view": Case(
        ("lang3dxl", "view", "castle.scene"),
        lambda folder: scene_in("castle.scene", folder, TAUGHT),
        keeps="castle.scene",
        serves="Ctrl-C ends it",
    ),
    "prepare": Case(("lang3dxl", "prepare", "--data", "data", *CLIP), targets),
}


if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(Kills).main()
