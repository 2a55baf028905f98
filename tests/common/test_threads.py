"""How OpenMP's threads wait: they sleep soon, whoever loads torch, unless the user chose otherwise."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CHOICES = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
SAID = "import os, sys; print(os.environ.get('GOMP_SPINCOUNT'), os.getpid(), *sys.argv[1:], sep='|')"


@pytest.fixture(scope="module")
def started(tmp_path_factory):
    """Runs Python with some words, in the place of torch a module that is loaded at once (what counts is who
    loads it first), and returns what it said and its process's number."""
    folder = tmp_path_factory.mktemp("torch")
    (folder / "torch.py").write_text("")

    def run(*words: str, **variables: str) -> tuple[list[str], int]:
        environment = {name: value for name, value in os.environ.items() if name not in CHOICES}
        environment["PYTHONPATH"] = os.pathsep.join([str(folder), *sys.path])
        with subprocess.Popen(
            [sys.executable, *words], env=environment | variables, stdout=subprocess.PIPE, text=True
        ) as process:
            said, _ = process.communicate(timeout=120)
        assert process.returncode == 0
        (line,) = said.splitlines()
        return line.split("|"), process.pid

    return run


@pytest.fixture(scope="module")
def ns_train(tmp_path_factory) -> str:
    """A program that loads torch before the plugin, as ns-train does."""
    path: Path = tmp_path_factory.mktemp("bin") / "ns-train"
    path.write_text(f"import torch, lang3dxl_ns\n{SAID}\n")
    return str(path)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="others have another OpenMP")
class TestThreads:
    def test_the_package_sets_it_before_torch_is_loaded(self, started):
        assert started("-c", f"import lang3dxl_ns\n{SAID}")[0][0] == "1000"

    def test_a_users_choice_stays(self, started, ns_train):
        assert started("-c", f"import lang3dxl_ns\n{SAID}", OMP_WAIT_POLICY="active")[0][0] == "None"
        assert started("-c", f"import lang3dxl_ns\n{SAID}", GOMP_SPINCOUNT="7")[0][0] == "7"
        assert started(ns_train, "lang3dxl", GOMP_SPINCOUNT="7")[0][0] == "7"

    @pytest.mark.parametrize("method", ["lang3dxl", "lang3dxl-paper"])
    def test_ns_train_starts_once_more_as_the_same_process(self, started, ns_train, method):
        words = [method, "--data", "a folder", "--empty", ""]
        said, process = started(ns_train, *words)
        assert said == ["1000", str(process), *words]

    def test_other_methods_and_programs_keep_their_own(self, started, ns_train):
        assert started(ns_train, "splatfacto")[0][0] == "None"
        imitated = f"import sys, torch; sys.argv = ['ns-train', 'lang3dxl']; import lang3dxl_ns\n{SAID}"
        assert started("-c", imitated)[0][0] == "None"
