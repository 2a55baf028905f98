"""Parallel workers: every item is done once, and a killed process loses no finished work."""

import sys

import pytest
from worker_tasks import Squares

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.parallel import run
from lang3dxl_ns.preparation.settings import PreparationConfig


def processes(folder):
    return {path.suffix for path in folder.glob("*.*")}


@pytest.mark.parametrize("count", [1, 2])
def test_every_item_comes_back_with_its_result(tmp_path, forked_workers, count):
    found = dict(run(PreparationConfig(workers=count), Squares(tmp_path).start, range(12), "cpu"))
    assert found == {item: item**2 for item in range(12)}
    assert len(list(tmp_path.glob("*.*"))) == 12
    assert len(processes(tmp_path)) <= count


def test_a_process_that_is_killed_ends_in_a_sentence_and_keeps_what_was_done(tmp_path):
    with pytest.raises(UserError, match=r"fewer --workers\. A script .* if __name__"):
        dict(run(PreparationConfig(workers=2), Squares(tmp_path, deadly=5).start, range(12), "cpu"))
    assert list(tmp_path.glob("*.*"))


def test_without_ray_the_error_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"pip install -e '\.\[ray\]'"):
        dict(run(PreparationConfig(workers=2, engine="ray"), Squares(tmp_path).start, range(3), "cpu"))
