"""The options that messages name exist in the command that is named with them, or that says them."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import get_args

import pytest
from test_help import options

import lang3dxl_ns
from lang3dxl_ns.cli import COMMANDS, settings_of
from lang3dxl_ns.common.options import OWN_NAMES
from lang3dxl_ns.preparation import model_files, segmentation

pytestmark = pytest.mark.nerfstudio  # for the options of ns-train

PACKAGE = Path(lang3dxl_ns.__file__).parent
FILES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
OF_ONE_COMMAND = {
    **{"training/fit.py": "train", "training/checkpoint.py": "train"},
    **{"attachment": "attach", "scene/add_photos.py": "reconstruct"},
}
OF_BOTH = ("common", "scene", "components", "rendering", "preparation", "training")
"""Rooms that speak to users of `lang3dxl train` and of `ns-train`, which spell options differently."""
COMMAND = re.compile(
    r"lang3dxl ((?:evaluate )?[a-z-]+)|(ns-train|lang3dxl-colmap)|(?:hf|convmv|ray|ns-process-data) "
)
OPTION = re.compile(r"(?<![\w-])--[a-z][\w.-]*")
AMISS = re.compile(r"(?:data|model|capture)_option\(|OPTION True|^(?!.*ns-train).*lang3dxl-colmap")
"""What these rooms may not say: a call in a text without its f, a flag's value, ns-train's word alone."""
SPELLERS = {
    "data_option": "--pipeline.datamanager.",
    "model_option": "--pipeline.model.",
    "capture_option": "--",
}
OF_MODELS = {**vars(model_files), **vars(segmentation)}
"""Names of options that are given to the functions that spell them."""


@cache
def of_ours() -> dict[str, set[str]]:
    """The options of each of our commands."""
    found = {}
    for name, (target, _) in COMMANDS.items():
        kind = None if isinstance(target, dict) else settings_of(target)
        if isinstance(kind, type):
            found[name] = options(kind) | {"--help", "--help-all"}
        elif kind is not None:
            commands = [get_args(command)[0] for command in get_args(kind)]
            found |= {
                f"{name} {kind.__name__.removeprefix('Evaluate').lower()}": options(kind) for kind in commands
            }
    return found


@cache
def of_ns_train() -> set[str]:
    from lang3dxl_ns.methods import METHODS
    from lang3dxl_ns.plugin.wrong_flags import _flags

    settings = METHODS["lang3dxl"].config
    return {*_flags(settings), *_flags(settings.pipeline.datamanager.dataparser), "--help", "--help-all"}


@pytest.fixture(autouse=True)
def helps_have_one_column(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def of_file(file: str) -> set[str]:
    """The options that messages of a file may name without a command."""
    room, ours = file.partition("/")[0], of_ours()
    if command := OF_ONE_COMMAND.get(file, OF_ONE_COMMAND.get(room)):
        return ours[command]
    if room in OF_BOTH:
        return ours["train"] & of_ns_train()
    return of_ns_train() if room == "plugin" else of_ns_train().union(*ours.values())


def speller(node: ast.AST) -> str | None:
    """The prefix of ns-train's options that a call gives, or None for other nodes."""
    call = node.value if isinstance(node, ast.FormattedValue) else node
    return SPELLERS.get(getattr(call.func, "id", "")) if isinstance(call, ast.Call) else None


def texts(tree: ast.AST) -> Iterator[str]:
    """The texts of several words in a module, without its docstrings."""
    nodes = list(ast.walk(tree))
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in nodes:
        if id(node) in docstrings | parts:
            continue
        values = node.values if isinstance(node, ast.JoinedStr) else [node]
        text = "".join(
            str(v.value) if isinstance(v, ast.Constant) else "OPTION" if speller(v) else "…" for v in values
        )
        if " " in text:
            yield text


def wrong_options(source: str, file: str) -> list[str]:
    """The options in messages of a module that a command lacks."""
    tree, wrong = ast.parse(source), []
    for text in texts(tree):
        if file.startswith(OF_BOTH) and (amiss := AMISS.search(text)):
            wrong.append(amiss[0])
        for option in OPTION.finditer(text):
            commands, there = list(COMMAND.finditer(text[: option.start()])), of_file(file)
            if commands:
                ours, trains = commands[-1].groups()
                there = of_ours()[ours] if ours else of_ns_train() if trains else {option[0].rstrip(".")}
            name = option[0].rstrip(".")
            is_group = option[0].endswith(".") and any(one.startswith(option[0]) for one in there)
            if name not in there and not is_group:
                wrong.append(name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and (prefix := speller(node)):
            (given,) = node.args
            given = given.values[0] if isinstance(given, ast.JoinedStr) else given
            name = OF_MODELS.get(given.id) if isinstance(given, ast.Name) else getattr(given, "value", None)
            if not isinstance(name, str) or not name:
                continue
            name = name.split()[0]
            theirs, ours = prefix + name, f"--{OWN_NAMES.get(name, name)}"
            wrong += [theirs] * (theirs not in of_ns_train())
            wrong += [ours] * (ours not in of_ours()["train"] and not file.startswith("plugin/"))
    return wrong


def test_messages_name_options_that_exist():
    found = {file: wrong_options((PACKAGE / file).read_text(), file) for file in FILES}
    assert {file: wrong for file, wrong in found.items() if wrong} == {}


@pytest.mark.parametrize(
    ("source", "file", "wrong"),
    [
        ("say('pass it as --data')", "scene/a.py", ["--data"]),
        ("say('pass it with --clip')", "scene/a.py", ["--clip"]),
        ("say('restart it with --restart')", "training/fit.py", []),
        ("say(f'{a}: write one with lang3dxl export --scen NAME')", "query/a.py", ["--scen"]),
        ("say(f'{a}: ns-train … lang3dxl-colmap --colmap-path {a}')", "scene/a.py", []),
        ("say('choose lang3dxl-colmap --colmap-path')", "scene/a.py", ["choose lang3dxl-colmap"]),
        ("say('give another {data_option(1)}')", "scene/a.py", ["data_option("]),
        ("say(f'pass {model_option(a)} True')", "scene/a.py", ["OPTION True"]),
        ("say(model_option('codes-form') + ' off')", "training/a.py", 
         ["--pipeline.model.codes-form", "--codes-form"]),
        ("say(data_option('camera-res-scale-factor'))", "training/a.py", ["--camera-res-scale-factor"]),
        ("say(data_option(CLIP_OPTION))", "preparation/a.py", []),
    ],
)  # fmt: skip
def test_an_option_that_a_command_lacks_is_found(source, file, wrong):
    assert wrong_options(source, file) == wrong
