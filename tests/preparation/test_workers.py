"""Many processes: every item is done once, and whoever dies takes nothing along."""

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.preparation.workers import Workers


@dataclass
class Squares:
    """Work that leaves a trace, and ends its process at one item, once."""

    folder: Path
    deadly: int = -1

    def start(self, device):
        def square(item):
            trap = self.folder / "sprung"
            if item == self.deadly and not trap.exists():
                trap.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            (self.folder / f"{item}.{os.getpid()}").touch()
            time.sleep(0.05)
            return item**2

        return square


def processes(folder):
    return {path.suffix for path in folder.glob("*.*")}


@pytest.mark.parametrize("count", [1, 2])
def test_every_item_comes_back_with_its_result(tmp_path, count):
    found = dict(Workers(count).run(Squares(tmp_path), range(12), "cpu"))
    assert found == {item: item**2 for item in range(12)}
    assert len(list(tmp_path.glob("*.*"))) == 12
    assert len(processes(tmp_path)) <= count


def test_a_process_that_is_killed_ends_in_a_sentence_and_keeps_what_was_done(tmp_path):
    with pytest.raises(UserError, match="fewer --workers"):
        dict(Workers(2).run(Squares(tmp_path, deadly=5), range(12), "cpu"))
    assert list(tmp_path.glob("*.*"))


@pytest.mark.slow
def test_on_a_ray_cluster_a_worker_that_is_killed_is_replaced_and_the_job_ends_complete(
    tmp_path, monkeypatch
):
    pytest.importorskip("ray")
    # The cluster's processes have to find this file.
    paths = (str(Path(__file__).parent), os.environ.get("PYTHONPATH", ""))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    maker = Squares(tmp_path, deadly=5)
    try:
        found = dict(Workers(2, "ray").run(maker, range(12), "cpu"))
    except UserError as error:
        pytest.skip(f"this machine is too busy to start a cluster: {error}")
    assert found == {item: item**2 for item in range(12)}
    assert (tmp_path / "sprung").exists()


def test_without_ray_the_error_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"lang3dxl-ns\[ray\]"):
        dict(Workers(2, "ray").run(Squares(tmp_path), range(3), "cpu"))
