"""A help shows what people need, and tells how to see the rest."""

import contextlib
import io
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import pytest
import tyro
from processes import Process

from lang3dxl_ns.common.settings_help import asked_for_all, showing, without


def options(kind, default=None) -> set[str]:
    said = io.StringIO()
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(said):
        tyro.cli(kind, default=default, args=["--help"], config=(tyro.conf.OmitArgPrefixes,))
    return set(re.findall(r"^[│ ]*(--[a-z][\w.-]*)", said.getvalue(), re.MULTILINE)) - {"--help"}


def settings():
    @showing("often")
    @dataclass
    class Settings:
        often: int = 1
        rarely: int = 2

    return Settings


def test_what_few_need_is_left_out_of_the_help_alone(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lang3dxl", "demo", "--help"])
    assert options(settings()) == {"--often"}
    for arguments in (["--help-all"], ["--rarely", "3"]):
        monkeypatch.setattr(sys, "argv", ["lang3dxl", "demo", *arguments])
        assert options(settings()) == {"--often", "--rarely"}
    assert tyro.cli(settings(), args=["--rarely", "3"]).rarely == 3
    assert asked_for_all(["demo", "--help-all"]) == ["demo", "--help"]


def test_a_setting_that_is_taken_off_is_neither_listed_nor_accepted(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lang3dxl", "train", "--help-all"])
    kind = without("rarely")(settings())
    assert options(kind) == {"--often"}
    with pytest.raises(SystemExit):
        tyro.cli(kind, args=["--rarely", "3"])


def test_the_help_has_the_settings_in_order_and_names_their_kind_alone(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["lang3dxl", "train", "--help"])

    @showing("out", "often")
    @dataclass
    class Ordered:
        often: int = 1
        rarely: int = 2
        out: Path | None = None

    with contextlib.suppress(SystemExit):
        tyro.cli(Ordered, args=["--help"])
    said = capsys.readouterr().out
    assert "--out PATH" in said and "None" not in said and "rarely" not in said
    assert said.index("--out") < said.index("--often")


@pytest.mark.parametrize("shown", [("place", "long"), ("place", "long", "rarely")])
def test_the_help_is_in_paragraphs_and_names_what_it_hides(monkeypatch, capsys, shown):
    """Continuation lines of a text begin with spaces, at which tyro would break it; what may be absent is in
    brackets."""
    monkeypatch.setattr(sys, "argv", ["lang3dxl", "train", "--help"])
    monkeypatch.setenv("COLUMNS", "200")

    @dataclass
    class Inherited:
        long: int = 1
        """One sentence that goes on
        in a second line."""

    @showing(*shown)
    @dataclass
    class Command(Inherited):
        """Do something."""

        place: tyro.conf.Positional[Path | None] = None
        """Folder."""
        rarely: int = 2

        def main(self) -> None: ...

    with contextlib.suppress(SystemExit):
        tyro.cli(Command, args=["--help"])
    said = capsys.readouterr().out
    assert "One sentence that goes on in a second line." in said and "[PATH]  " in said
    assert ("--help-all" in said) is ("rarely" not in said) is ("rarely" not in shown)


def count() -> None:
    """Prints how many settings the help of ns-train shows, and how many flags that of all our commands, which
    are imported anew: classes of settings look for --help."""
    sys.argv, os.environ["COLUMNS"] = ["lang3dxl", "--help"], "80"  # one column of flags
    for name in [name for name in sys.modules if name.partition(".")[0] in ("lang3dxl_ns", "lab")]:
        del sys.modules[name]
    from lang3dxl_ns.cli import COMMANDS, settings_of
    from lang3dxl_ns.methods import lang3dxl

    def flags(target) -> int:
        if isinstance(target, dict):
            return sum(flags(found) for found, _ in target.values())
        command = settings_of(target)
        kinds = [command] if isinstance(command, type) else [get_args(kind)[0] for kind in get_args(command)]
        return sum(len(options(kind)) for kind in kinds)

    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        tyro.cli(tyro.conf.SuppressFixed[type(lang3dxl.config)], default=lang3dxl.config, args=["--help"])
    training = set(re.findall(r"^[│ ]*(--[a-z][\w.-]*)", said.getvalue(), re.MULTILINE))
    print(len(training), sum(flags(target) for target, _ in COMMANDS.values()))


@pytest.mark.slow
@pytest.mark.nerfstudio
def test_ns_train_shows_at_most_80_settings_and_our_commands_120_flags():
    done = Process(count).wait()
    assert done.returncode == 0, done.stderr
    training, commands = map(int, done.stdout.split())
    assert 60 < training <= 80
    assert 90 < commands <= 120
