"""What the console shows, and what it doesn't."""

import io
import sys
import time
import warnings

import pytest
import rich.progress
import torch

from lang3dxl_ns.common import console
from lang3dxl_ns.common.console import progress, say, silence_libraries, some, tracked
from lang3dxl_ns.evaluation.photo_metrics import ImageMetrics


@pytest.mark.parametrize(
    ("message", "heard"),
    [
        ("`torch.jit.script` is deprecated. Please switch", False),
        ("`torch.cuda.amp.GradScaler(args...)` is deprecated", False),
        ("Detected call of `lr_scheduler.step()` before `optimizer.step()`", False),
        ("Something that nobody has heard of yet", True),
    ],
)
def test_known_warnings_of_libraries_are_silent_and_others_are_not(message, heard):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        silence_libraries()
        warnings.warn(message, FutureWarning, stacklevel=1)
    assert [str(w.message) for w in caught] == ([message] if heard else [])


def test_alexnet_is_not_downloaded_unasked(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *_, **__: pytest.fail("a download"))
    picture, metrics = torch.rand(64, 64, 3), ImageMetrics()
    assert all("lpips" not in metrics(picture, picture) for _ in range(2))
    assert capsys.readouterr().out.count("LPIPS is skipped") == 1  # said once


def test_a_first_item_of_minutes_shows_the_bar_and_quick_work_shows_none(monkeypatch, capsys):
    for quiet, shown in ((60.0, False), (0.01, True)):
        monkeypatch.setattr(console, "QUIET_S", quiet)
        for item in tracked([1], "one long item"):
            time.sleep(0.3 * item)
        assert ("one long item" in capsys.readouterr().out) is shown


def test_the_time_left_is_that_of_equal_lots(monkeypatch):
    """Matching a video's photos advances by a hundred pairs at a time, seconds apart."""
    now, bars = [0.0], []

    class Clocked(rich.progress.Progress):
        def __init__(self, *columns, **options):
            super().__init__(*columns, **options, get_time=lambda: now[0], disable=True)
            bars.append(self)

    monkeypatch.setattr(rich.progress, "Progress", Clocked)
    lots, seconds = 17, 9.0
    with progress("pairs of photos", 100 * lots) as advance:
        for done in range(1, lots):
            now[0] += seconds
            advance(100)
            if done > 1:
                left = bars[0].tasks[0].time_remaining
                assert left == pytest.approx((lots - done) * seconds, rel=0.1, abs=1)


def test_an_output_that_lacks_a_character_ends_no_script(monkeypatch):
    """Windows gives a file that output is sent to the encoding of its own language."""
    narrow = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr(sys, "stdout", narrow)
    say("Фото of Köln")
    narrow.flush()
    assert narrow.buffer.getvalue() == b"\\u0424\\u043e\\u0442\\u043e of K\xf6ln\n"


def test_a_name_with_a_line_break_stays_in_its_line():
    assert some(["new\nline.jpg", "b.jpg"]) == "new\\nline.jpg, b.jpg"
