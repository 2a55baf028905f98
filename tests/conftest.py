"""What tests share: small scenes, tiny encoders, and short training runs.

- `scene`, `tiny_clip`, `tiny_dense`: read-only, made once per process that tests.
- `train`: a short training with settings of your own, a small sky, and 20 small steps of learning codes of
  three numbers (after so few steps three often seem not enough, and four and six take five times as long). It
  takes half a second and 15 ms per step: take as few as the law needs, and a module's fixture
  (`runs.train_run`) where several tests only look at the same run.
- `browser`, `page` (tests/web/conftest.py): Chromium, and the painted wall's page, as it opens; a page of
  another scene costs a second more.
- `processes.run("ns-eval", …)`: a command in a process that has the libraries loaded (a second, not ten);
  `processes.Process(function, …)`: a function in one. Commands that train learn codes for 15 seconds, unless
  told `--pipeline.model.decoder.compression.steps 40`.
- `worker_tasks`: work for several processes; tests that need a Ray cluster belong into test_ray.py, which
  has one.
"""

import ast
import gc
import inspect
import os
import sys
from collections import Counter
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from processes import SERVER
from runs import train_run
from scenes import write_scene
from tiny_models import make_tiny_clip, make_tiny_dinov2

from lang3dxl_ns.common.errors import NO_NERFSTUDIO

# No test may contact a model hub.
os.environ["HF_HUB_OFFLINE"] = "1"
# A thread per process where several test at a time: more would wait for each other. Commands inherit it.
# Numba is told as well: the first of its parallel functions (gsply has some) sets the number for torch, too.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    torch.set_num_threads(1)
torch.set_num_threads(min(torch.get_num_threads(), 2))


def callers(context: int = 0) -> list[inspect.FrameInfo]:
    """`inspect.stack` without the lines of code. nerfstudio asks for the stack 26 times when it is imported,
    to read one name, and among thousands of modules the search for those lines takes seconds."""
    frame, found = sys._getframe(1), []
    while frame is not None:
        code = frame.f_code
        found.append(inspect.FrameInfo(frame, code.co_filename, frame.f_lineno, code.co_name, None, None))
        frame = frame.f_back
    return found


inspect.stack = callers


HAS_NERFSTUDIO = find_spec("nerfstudio") is not None
NEEDS_NERFSTUDIO = ("nerfstudio", "viser", "lang3dxl_ns.plugin", "lang3dxl_ns.methods")


@cache
def imports_nerfstudio(path: Path) -> bool:
    """Whether a file of tests imports nerfstudio, or our side of it, at its top."""
    names = []
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom):
            names.append(f"{node.module}.")
        elif isinstance(node, ast.Import):
            names += [f"{alias.name}." for alias in node.names]
    return any(name.startswith(f"{need}.") for name in names for need in NEEDS_NERFSTUDIO)


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Without nerfstudio, tests of the plugin and files that import it are left out. `.ci/run` tests the base
    so, on a newer Python."""
    if HAS_NERFSTUDIO or collection_path.suffix != ".py":
        return None
    return True if "plugin" in collection_path.parts or imports_nerfstudio(collection_path) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests first: at the end, a slow test would leave the other process idle. Tests that
    train with nerfstudio, or are marked so, are skipped without it."""
    if not HAS_NERFSTUDIO:
        for item in items:
            if {"train", "two_steps"} & set(getattr(item, "fixturenames", ())) or item.get_closest_marker(
                "nerfstudio"
            ):
                item.add_marker(pytest.mark.skip(reason=NO_NERFSTUDIO))
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


def pytest_collection_finish(session: pytest.Session) -> None:
    """Commands get their server where tests are run that may need it. What is imported by now stays, so the
    garbage collector leaves it alone: millions of objects, which take it a second or two each time."""
    gc.collect()
    gc.freeze()
    if session.items and "processes" in sys.modules and not session.config.option.collectonly:
        sys.modules["processes"].start_server()


def pytest_runtest_teardown() -> None:
    """Runs end with their test: nerfstudio adds the writers of a run to those of all before it in the
    process, and each of them writes every number of every later run."""
    if writer := sys.modules.get("nerfstudio.utils.writer"):
        for one in writer.EVENT_WRITERS:
            if isinstance(one, writer.TensorboardWriter):
                one.tb_writer.close()
        writer.EVENT_WRITERS.clear()
        writer.EVENT_STORAGE.clear()


@pytest.fixture(scope="session")
def tiny_clip(tmp_path_factory) -> Path:
    """Directory of a CLIP of random weights."""
    return make_tiny_clip(tmp_path_factory.mktemp("models") / "clip")


@pytest.fixture(scope="session")
def tiny_dense(tmp_path_factory) -> Path:
    """Directory of a DINOv2 of random weights."""
    return make_tiny_dinov2(tmp_path_factory.mktemp("models") / "dinov2")


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Path:
    """A collection of twelve photos of mixed sizes with a COLMAP model."""
    return write_scene(tmp_path_factory.mktemp("scene"), photos=12, points=400, mixed=True)


@pytest.fixture(scope="module")
def two_steps(tmp_path_factory, tiny_clip, tiny_dense):
    """The trainer of a finished run of two steps, whose files tests may damage copies of."""
    root = tmp_path_factory.mktemp("run")
    data = write_scene(root / "scene", photos=4, points=60)
    return train_run(data, tiny_clip, tiny_dense, root / "outputs", iterations=2)


@pytest.fixture
def train(tiny_clip, tiny_dense, tmp_path):
    """Train like `ns-train lang3dxl`, in this process; returns the trainer."""

    def run(data: Path, iterations: int = 40, output_dir: Path = tmp_path, semantics: bool = True, **changes):
        """`changes` are set by their dotted path, with __ for each dot."""
        return train_run(data, tiny_clip, tiny_dense, output_dir, iterations, semantics, **changes)

    return run


@pytest.fixture(scope="session")
def real_scenes() -> Path:
    """Folder of the two real photo scenes."""
    folder = os.environ.get("LANG3DXL_REAL_SCENES")
    if not folder:
        pytest.skip("set LANG3DXL_REAL_SCENES to the folder that holds sceaux and sceaux_wild")
    return Path(folder)


@pytest.fixture
def forked_workers(monkeypatch) -> None:
    """Workers begin with the libraries loaded, which they would import for ten seconds each. The test of one
    that is killed has a true start."""
    monkeypatch.setattr("lang3dxl_ns.common.parallel.get_context", lambda _: SERVER)


@pytest.fixture(params=["torch", "numba"])
def backend(request, monkeypatch) -> str:
    """The CPU rasterizer that "auto" selects in this test: both pass the same laws."""
    monkeypatch.setenv("LANG3DXL_CPU_KERNELS", request.param)
    return request.param
