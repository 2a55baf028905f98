"""Stages of a command: announced, timed, and their time left estimated."""

import itertools
import json
from contextlib import suppress

import pytest

from lab.stages import MeasuredStages
from lang3dxl_ns.common import stages as module
from lang3dxl_ns.common.stages import Stages

SHARES = {"fetch": 0.2, "cook": 0.5, "serve": 0.3}


@pytest.fixture
def clock(monkeypatch):
    """The time, which only stands where a test puts it."""
    time = [0.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: time[0])
    return time


def test_stages_say_where_they_are_and_what_is_left(tmp_path, capsys, clock):
    stages = MeasuredStages(SHARES, tmp_path / "stages.json")
    for name, share in SHARES.items():
        with stages.stage(name):
            clock[0] += 6000 * share
    lines = [line for line in capsys.readouterr().out.splitlines() if line]
    assert lines == [
        "1 of 3: fetch",
        "2 of 3: cook (about 80 minutes left)",
        "3 of 3: serve (about 30 minutes left)",
    ]
    assert stages.figures()["seconds"] == {"fetch": 1200, "cook": 3000, "serve": 1800}


@pytest.mark.parametrize("steps", [10, 997])
def test_at_a_steady_pace_every_estimate_is_right(steps, capsys, clock):
    stages = Stages(SHARES)
    with stages.stage("cook"):
        for step in range(steps):
            clock[0] += 3000 / steps
            stages.progress((step + 1) / steps)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("cook")]
    assert len(lines) in (9, 10)  # early, unless a step is a tenth; every tenth, but for the end
    assert lines[-9].startswith("cook: 10 % done")
    for line in lines:
        done = int(line.split()[1]) / 100
        truth = (3000 * (1 - done) + 1800) / 60
        assert int(line.split("about ")[1].split()[0]) == pytest.approx(truth, abs=1.01)


def test_estimates_follow_a_change_of_pace(capsys, clock):
    """Another program comes when a third is done, and slows everything by 8: two minutes later, estimates
    know it; nothing is announced in between at a wrong pace for long."""
    stages = Stages(SHARES)
    with stages.stage("cook"):
        for step in range(3000):
            clock[0] += 0.1 if step < 1000 else 0.8
            stages.progress((step + 1) / 3000)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("cook: ")]
    for line in lines:
        done = int(line.split()[1]) / 100
        if done >= 0.4:
            truth = 0.8 * 3000 * (1 - done + 0.6) / 60
            assert truth / 2 < int(line.split("about ")[1].split()[0]) < 2 * truth


def test_a_short_stage_is_silent(capsys, clock):
    stages = Stages(SHARES)
    with stages.stage("serve"):
        for step in range(100):
            clock[0] += 0.1
            stages.progress((step + 1) / 100)
    assert capsys.readouterr().out.splitlines() == ["", "3 of 3: serve"]


def test_seconds_add_up_over_interrupted_commands(tmp_path, clock):
    for _ in range(3):
        stages = MeasuredStages(SHARES, tmp_path / "stages.json")
        with suppress(KeyboardInterrupt), stages.stage("cook"):
            clock[0] += 7
            raise KeyboardInterrupt
    assert json.loads((tmp_path / "stages.json").read_text())["cook"]["seconds"] == 21


def test_a_stage_that_begins_ends_the_one_before(tmp_path, clock):
    stages = MeasuredStages(SHARES, tmp_path / "stages.json")
    for name, seconds in itertools.chain(SHARES.items(), SHARES.items()):
        stages.begin(name)
        clock[0] += seconds
    stages.end()
    stages.end()
    stages.progress(0.5)  # outside a stage: nothing to say
    assert stages.figures()["seconds"] == {name: pytest.approx(2 * s, abs=0.1) for name, s in SHARES.items()}
