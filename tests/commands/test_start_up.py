"""Start-up: what `lang3dxl` commands import before they begin; the list of commands."""

import json
import subprocess
import sys

import pytest
from processes import output

from lang3dxl_ns import cli

HEAVY = {
    *("torch", "torchvision", "nerfstudio", "gsplat", "viser", "transformers", "sklearn", "scipy", "skimage"),
    *("matplotlib", "pycolmap", "cv2", "numba", "ray"),
}
OF_TORCH = {"query", "export"}
"""Commands whose settings are still defined beside work that needs torch."""
HELP = """
import io, json, sys
from contextlib import redirect_stdout, suppress
from lang3dxl_ns import cli
loaded = {}
for words in json.loads(sys.argv[1]):
    with suppress(SystemExit), redirect_stdout(io.StringIO()):
        cli.main(words)
    loaded[" ".join(words)] = sorted(set(json.loads(sys.argv[2])) & set(sys.modules))
print(json.dumps(loaded))
"""
"""Runs commands one after the other; says after each which of some modules are loaded by then."""


def loaded(*commands: list[str]) -> dict[str, list[str]]:
    words = [sys.executable, "-c", HELP, json.dumps(commands), json.dumps(sorted(HEAVY))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_help_and_the_doctor_load_no_heavy_library():
    own = {"numerics", "benchmark"} | OF_TORCH  # which say what they measure on
    commands = [["--help"], ["no-such-command"], ["doctor"], ["benchmark", "--help"]]
    commands += [[name, "--help"] for name in cli.COMMANDS if name not in own]
    commands += [["evaluate", kind, "--help"] for kind in ("maps", "run", "pool", "split")]
    commands += [["demo-scene", "--out", "scene", "--photos", "2"]]  # each of its workers imports as much
    found = loaded(*commands, ["preset", "holyscenes/milano"])
    assert {command: names for command, names in found.items() if names} == {}


@pytest.mark.parametrize("name", [*cli.COMMANDS, *(f"benchmark {name}" for name in cli.BENCHMARKS)])
def test_every_command_that_is_listed_has_a_help_of_its_own(name, capsys):
    with pytest.raises(SystemExit, match=r"^0$"):
        cli.main([*name.split(), "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert f"{name} [-h]" in said
    assert "NotCalled" not in said


def test_the_installed_command_lists_all_others():
    said = output("lang3dxl", "--help", shell=True)
    assert all(f"• {name} " in said for name in cli.COMMANDS)


def test_what_opens_a_scene_file_loads_only_what_it_needs():
    """`load_scene` takes 1.3 s of the processor, of which torch has 1.1."""
    code = "import sys, lang3dxl_ns.open_scene, lang3dxl_ns.files.scene_file; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert HEAVY & set(done.stdout.split()) == {"torch"}, done.stderr
