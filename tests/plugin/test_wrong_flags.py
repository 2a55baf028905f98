"""A wrong flag of ns-train is named in one line, with the nearest flag or the place where it belongs."""

import sys

import pytest
import tyro

from lang3dxl_ns.methods import METHODS
from lang3dxl_ns.plugin.wrong_flags import name_wrong_flags, wrong_flag

SETTINGS = METHODS["lang3dxl"].config


@pytest.mark.parametrize(
    ("flag", "said"),
    [
        ("--max-num-iteration", "no --max-num-iteration: did you mean --max-num-iterations?"),
        ("--pipeline.datamanager.clipp", "did you mean --pipeline.datamanager.clip?"),
        ("--pipeline.model.sh_degre", "did you mean --pipeline.model.sh-degree?"),
        ("--follow-lnks", "did you mean --follow-links?"),
        ("--zzz", "has no --zzz: ns-train lang3dxl --help-all"),
        ("--max-num-iterations", "belongs before the word lang3dxl-colmap"),
        ("--eval-mode", "belongs at the end, after the word lang3dxl-colmap"),
    ],
)
def test_the_line(flag, said):
    assert said in wrong_flag(SETTINGS, ["lang3dxl", f"{flag}=3"], flag[:8])


def test_all_flags_that_tyro_knows_are_right(monkeypatch, capsys):
    """Every suggestion exists: tyro takes it, and the parser is left as it was found."""
    monkeypatch.setattr(tyro, "cli", tyro.cli)
    name_wrong_flags(SETTINGS)
    monkeypatch.setattr(sys, "argv", ["ns-train", "lang3dxl", "--machine.sed", "3"])
    with pytest.raises(SystemExit) as ended:
        tyro.cli(type(SETTINGS.machine), args=["--machine.sed", "3"])
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "did you mean --machine.seed?" in line
    with pytest.raises(SystemExit):  # not of our making: tyro's own words stay
        tyro.cli(type(SETTINGS.machine), args=["--seed", "x"])
    assert "--seed" in capsys.readouterr().err
    assert tyro.cli(type(SETTINGS.machine), args=["--seed", "3"]).seed == 3


def test_what_is_said_beside_a_right_command_line_stays(monkeypatch, capsys):
    monkeypatch.setattr(tyro, "cli", lambda *_, **__: print("a warning", file=sys.stderr) or 3)
    name_wrong_flags(SETTINGS)
    assert tyro.cli() == 3 and capsys.readouterr().err == "a warning\n"
