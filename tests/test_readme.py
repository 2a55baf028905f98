"""The README's commands and snippets, run as printed, on a small run of the demo."""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest
from processes import output

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def section(title: str) -> str:
    """A section of the README, to the next one."""
    return README.split(f"\n## {title}\n")[1].split("\n## ")[0]


def blocks(language: str, text: str) -> list[str]:
    """The section's code blocks."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("readme")


@pytest.fixture(scope="module")
def demo_output(folder) -> str:
    few = ("--photos", 12, "--test-views", 3, "--steps", 150)
    return output("lang3dxl", "demo", "--quick", *few, cwd=folder, shell=True, timeout=1800)


def test_the_quick_demo_finds_words_in_photos_that_it_has_never_seen(demo_output, folder):
    report = json.loads((folder / "lang3dxl-demo" / "report.json").read_text())
    for split in report["splits"].values():
        assert split["teacher_map"] > 0.5
        assert split["map"] > 0.35
        # By direction: features read from crops and patches are shorter than the pyramid's.
        assert 1 - split["clip_cosine"] < 0.8 * (1 - split["clip_cosine_of_mean"])
    assert "lang3dxl view lang3dxl-demo" in demo_output


def test_questions_from_the_shell(demo_output, folder):
    commands = [line for block in blocks("bash", section("Ask it")) for line in block.splitlines()]
    asked = [line for line in commands if line.startswith("lang3dxl ")]
    assert len(asked) >= 2
    for line in asked:
        output(*shlex.split(line, comments=True), cwd=folder)
    assert {"query.json", "portals", "towers"} <= {path.name for path in (folder / "found").iterdir()}
    assert list((folder / "found" / "towers").glob("*.overlay.png"))
    assert (folder / "towers.ply").read_bytes().startswith(b"ply")


def test_questions_from_python(demo_output, folder):
    (snippet,) = blocks("python", section("Ask it"))
    shown = "\nprint(match.relevancy.shape, match.mask.dtype, match.peak, places.gaussians.sum())"
    unwanted = ("nerfstudio", "gsplat", "viser", "lang3dxl_ns.plugin")  # a scene file needs none of these
    shown += f"\nimport sys; assert not [name for name in sys.modules if name.startswith({unwanted})]"
    assert "bool" in output(sys.executable, "-c", snippet + shown, cwd=folder, shell=True)


@pytest.mark.nightly
def test_the_notebook_runs_from_top_to_bottom(demo_output, folder):
    import nbformat  # here: they take five seconds to load, in every process that collects tests
    from nbclient import NotebookClient

    notebook = nbformat.read(ROOT / "docs" / "tour.ipynb", as_version=4)
    client = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}})
    client.execute()
    (outputs,) = (cell.outputs for cell in notebook.cells if "match.score" in cell.source)
    assert "best relevancy" in "".join(output.get("text", "") for output in outputs), outputs
    assert (folder / "towers.ply").read_bytes().startswith(b"ply")
