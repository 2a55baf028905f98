"""Memory limits of control groups: the least of all groups above a process counts, in both versions."""

import os
import resource

import pytest

from lang3dxl_ns.common import memory

GB = 2**30


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """Control groups in a folder, and a process in some of them: write limits, then ask."""
    monkeypatch.setattr(memory, "_CGROUPS", tmp_path)
    monkeypatch.setattr(memory, "_OWN", tmp_path / "own")

    def limit(own: str, **limits: object) -> int:
        (tmp_path / "own").write_text(own)
        for place, value in limits.items():
            path = tmp_path / place.replace("__", "/").replace("memory_max", "memory.max").replace(
                "limit_in_bytes", "memory.limit_in_bytes"
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{value}\n")
        return memory.machine_memory()

    return limit


def test_every_group_above_a_process_limits_it(groups):
    own = "0::/user/batch/job\n"
    assert groups(own, user__batch__memory_max=GB // 2, user__batch__job__memory_max="max") == GB // 2
    assert groups(own, memory_max=GB // 4) == GB // 4
    assert groups(own, user__batch__job__memory_max=GB // 8) == GB // 8


def test_groups_of_the_first_version_count_too(groups):
    own = "9:name=systemd:/\n4:memory:/service/worker\n1:cpu:/elsewhere\n"
    assert groups(own, memory__elsewhere__limit_in_bytes=5) > GB // 4  # another controller's group
    assert groups(own, memory__service__limit_in_bytes=GB // 4) == GB // 4
    assert groups(own, memory__limit_in_bytes=GB // 16) == GB // 16


def test_a_group_that_this_container_does_not_show_is_left_out(groups):
    assert groups("0::/../../host/group\n", memory_max=GB // 2) == GB // 2
    assert groups("nonsense\n") == GB // 2


def test_a_processs_own_limit_counts_too(groups, monkeypatch):
    """As batch systems set it."""
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (2 * GB, 4 * GB))
    assert groups("0::/box", box__memory_max=3 * GB) == 2 * GB
    assert groups("0::/box", box__memory_max=1 * GB) == 1 * GB


def test_a_system_that_tells_no_memory_is_planned_for_all_the_same(groups, monkeypatch):
    """Windows has no sysconf."""
    monkeypatch.delattr(os, "sysconf")
    assert groups("") == 8 * GB
    assert groups("0::/box", box__memory_max=3 * GB) == 3 * GB
