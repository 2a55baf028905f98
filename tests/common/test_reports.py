"""Benchmark reports: machine line, atomic writes."""

import json
import os
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import pytest
import torch

from lab.reports import command_line
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report


@dataclass
class Settings:
    out: Path
    repeats: int = 5
    quick: bool = False
    image_sizes: tuple[tuple[int, int], ...] = field(default_factory=lambda: ((160, 120),))


def test_machine_line_names_cores_threads_torch_and_date():
    line = describe_machine()
    assert f"{os.cpu_count()} cores" in line
    assert f"{torch.get_num_threads()} thread" in line
    assert torch.__version__ in line
    assert date.today().isoformat() in line


def test_command_line_has_exactly_the_flags_that_differ_from_their_defaults():
    assert command_line("lang3dxl benchmark", Settings(Path("a b"))) == "lang3dxl benchmark --out 'a b'"
    changed = Settings(Path("o"), quick=True, image_sizes=((8, 6), (4, 3)))
    assert command_line("x", changed) == "x --out o --quick --image-sizes 8 6 4 3"


def test_table_has_a_line_for_each_row_and_a_dash_for_what_is_missing():
    assert markdown_table(["a", "b"], [[1, None]]) == "| a | b |\n| --- | --- |\n| 1 | – |"


def test_report_is_written_as_markdown_and_json(tmp_path):
    write_report(tmp_path / "new", "speed", "# Speed", {"ratio": 2.5})
    assert (tmp_path / "new" / "speed.md").read_text() == "# Speed\n"
    assert json.loads((tmp_path / "new" / "speed.json").read_text()) == {"ratio": 2.5}


def test_a_report_with_nan_is_refused_and_the_old_one_stays(tmp_path):
    write_report(tmp_path, "speed", "old", {"ratio": 1.0})
    with pytest.raises(ValueError, match="JSON"):
        write_report(tmp_path, "speed", "new", {"ratio": float("nan")})
    assert (tmp_path / "speed.md").read_text() == "old\n"
    assert json.loads((tmp_path / "speed.json").read_text()) == {"ratio": 1.0}
