"""Wheel and sdist: the same bytes each time, all that a checkout has; commands run from the wheel alone."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from filelock import FileLock
from scenes import write_scene

pytest.importorskip("build")
from build import ProjectBuilder
from build.env import DefaultIsolatedEnv

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with all that `python -m build` makes: the wheel of the checkout, two sdists, and the wheel of
    one of them. Made once for all processes that test, in one isolated environment."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    with FileLock(shared / "built.lock"):
        if not (shared / "built").exists():
            build(tmp_path_factory.mktemp("built")).rename(shared / "built")
    return shared / "built"


def build(folder: Path) -> Path:
    with DefaultIsolatedEnv() as environment:
        checkout = ProjectBuilder.from_isolated_env(environment, ROOT)
        environment.install(checkout.build_system_requires)
        for kind in ("sdist", "wheel"):
            environment.install(checkout.get_requires_for_build(kind))
        checkout.build("wheel", folder / "wheel")
        sdist, _ = (checkout.build("sdist", folder / f"sdist-{number}") for number in (1, 2))
        shutil.unpack_archive(sdist, folder / "unpacked")
        (source,) = (folder / "unpacked").iterdir()
        ProjectBuilder.from_isolated_env(environment, source).build("wheel", folder / "wheel-of-sdist")
    return folder


@pytest.fixture
def wheel(built) -> Path:
    return next((built / "wheel").iterdir())


def test_the_sdist_is_reproducible_and_makes_the_same_wheel(built):
    def content(folder: str) -> bytes:
        (path,) = (built / folder).iterdir()
        return path.read_bytes()

    assert content("sdist-1") == content("sdist-2")
    assert content("wheel-of-sdist") == content("wheel")


def test_the_sdist_holds_the_project_alone(built):
    """A checkout holds environments and scenes too, of gigabytes."""
    (source,) = (built / "unpacked").iterdir()
    ours = {".ci", "configs", "docs", "lab", "lang3dxl_ns", "tests", "pyproject.toml"}
    told = {"README.md", "LICENSE", "CITATION.cff", "PKG-INFO", ".gitignore"}
    assert {path.name for path in source.iterdir()} == ours | told


def test_commands_run_from_it_alone(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "installed")}
    write_scene(tmp_path / "scene", photos=4)
    commands = ["preset", "prepare --data scene --clip builtin --scale-range 0.5 1.5 --dense-tokens 8"]
    code = "import lang3dxl_ns, sys; from lang3dxl_ns.cli import main; print(lang3dxl_ns.__file__)\n"
    code += "for words in sys.argv[1:]: main(words.split())"
    done = subprocess.run(
        [sys.executable, "-c", code, *commands],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path / "installed"))
    assert "holyscenes/milano" in done.stdout
    assert "Targets of 4 photos" in done.stdout
    page = tmp_path / "installed" / "lang3dxl_ns" / "web"
    assert {path.name for path in page.iterdir()} >= {"index.html", "page.js", "splats.js", "LICENSES.txt"}


ENDS = """
import io, json, sys
from contextlib import redirect_stdout
from lang3dxl_ns.cli import main
for words in sys.argv[1:]:
    try:
        with redirect_stdout(io.StringIO()) as said:
            main(words.split())
    except SystemExit as end:
        print(json.dumps([str(end), said.getvalue()]))
"""
"""Runs commands one after the other; says how each ended, and what it printed."""


def test_commands_of_a_checkout_are_listed_and_tell_the_remedy(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path)
    commands = [f"{name} --out report" for name in ("numerics", "benchmark ablation", "demo-scene", "demo")]
    words = [sys.executable, "-c", ENDS, "--help", "benchmark --help", *commands]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    ends = [json.loads(line) for line in done.stdout.splitlines()]
    helped, refused = ends[:2], ends[2:]
    assert len(refused) == 4, done.stderr
    for (end, said), listed in zip(helped, ("numerics", "ablation"), strict=True):
        assert end == "0" and f"• {listed} " in said
    for end, _ in refused:
        assert end.startswith("Error: this command comes with a checkout of the repository")


def test_the_version_is_the_same_everywhere(wheel):
    version = re.search(r'^version = "(.*)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)[1]
    assert f"-{version}-" in wheel.name
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {version}" in (ROOT / "docs" / "changelog.md").read_text()
