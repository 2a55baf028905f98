"""The `lang3dxl` command: all tasks except rendering and training with a viewer, which ns-* commands do."""

from __future__ import annotations

import contextlib
import operator
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextvars import copy_context
from dataclasses import dataclass
from difflib import get_close_matches
from functools import reduce
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import tyro

from lang3dxl_ns.common.checks import disk_trouble
from lang3dxl_ns.common.console import accept_any_console, keep_standard_numbers, silence_libraries
from lang3dxl_ns.common.errors import NO_NERFSTUDIO, UserError, misses_nerfstudio
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.common.memory import ran_out_of_memory
from lang3dxl_ns.common.settings_help import asked_for_all
from lang3dxl_ns.common.stopping import end_at_once

LAB = Path(__file__).parents[1] / "lab"
BENCHMARKS = {
    "ablation": ("lab.benchmarks.ablation:Ablation", "The method, baselines, and ablations."),
    "gpu": ("lab.benchmarks.gpu:GpuBenchmark", "A GPU: parity, numerics, time, memory, in one file to send."),
    "holyscenes": ("lab.benchmarks.published:HolyScenes", "HolyScenes, beside the published figures."),
    "lerf-ovs": ("lab.benchmarks.published:LerfOvs", "LERF-OVS, beside the published figures."),
    "pt-ovs": ("lab.benchmarks.published:PtOvs", "PT-OVS, scene by scene."),
    "trust": ("lab.benchmarks.trust:TrustBenchmark", "Cautions under wrong answers, and under right ones."),
    "page": ("lab.benchmarks.page:PageBenchmark", "Seconds until the page of a scene answers."),
    "things": ("lab.benchmarks.things:ThingsBenchmark", "Single windows and towers: F1, counts, boxes."),
    "attach": ("lab.benchmarks.attach:AttachBenchmark", "Words attached to a splat, beside its run's."),
}
COMMANDS = {
    "demo": ("lab.landmark.demo:Demo", "The full workflow in minutes, on a generated landmark."),
    "train": ("commands.train:Train", "A scene from photos; a stopped run goes on."),
    "reconstruct": ("commands.prepare:Reconstruct", "COLMAP model from photos, or a video."),
    "prepare": ("commands.prepare:Prepare", "Make the targets that training learns from, in advance."),
    "attach": ("commands.attach:Attach", "Words for a splat that any program made: PLY, SPZ, checkpoints."),
    "doctor": ("commands.doctor:Doctor", "Check this machine, with remedies."),
    "needs": ("commands.prepare:Needs", "Which optional components a scene needs, and why."),
    "query": ("commands.query:Query", "Search a trained scene for texts: heat maps, masks, relevancy maps."),
    "things": (
        "commands.things:ListThings",
        "List, count and ask for single things: windows, portals, towers.",
    ),
    "export": ("commands.export:Export", "Write a scene, or what matches a text, as a splat or a web page."),
    "teach": ("commands.teach:Teach", "Show a scene what a word means, by marking it in a photo."),
    "words": ("commands.teach:Words", "List, forget, save and load the words that a scene was taught."),
    "info": ("commands.view:Info", "Show a scene file's contents and origin."),
    "view": ("commands.view:View", "Explore and query a trained scene in a browser."),
    "demo-scene": ("lab.landmark.demo_scene:DemoScene", "Generate photos of a procedural landmark."),
    "evaluate": ("commands.evaluate:Evaluate", "Score words against ground truth."),
    "preset": ("commands.preset:Preset", "Print the flags that train a benchmark's scene as in the paper."),
    "numerics": ("lab.numerics.command:Numerics", "Error and time of components on stiff cases."),
    "benchmark": (BENCHMARKS, "Measure: time, memory and error, side by side."),
}
"""Settings class of each command, which has a method `main`, and its summary in the list of commands.
Commands of `lab` are available only in a checkout."""


def main(arguments: list[str] | None = None) -> None:
    """Run the `lang3dxl` command (its entry point)."""
    words = asked_for_all(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    keep_standard_numbers()
    silence_libraries()
    accept_any_console()
    if words[:1] == ["--version"]:
        return print(version("lang3dxl-ns"))
    try:
        os.getcwd()  # torch's libraries can't be loaded in a folder that is gone
    except FileNotFoundError:
        sys.exit("Error: the current folder was deleted: change to another one")
    try:
        with _terminable(ends=arguments is None):
            copy_context().run(_parsed(words).main)  # undoes the command's message settings
            if sys.stdout is not None:  # closed at the start
                sys.stdout.flush()
    except UserError as error:
        sys.exit(f"Error: {error}")
    except ModuleNotFoundError as error:
        if not misses_nerfstudio(error):
            raise
        sys.exit(f"Error: {NO_NERFSTUDIO}")
    except BrokenPipeError:  # the reader closed the pipe, as in `lang3dxl … | head`
        _leave_output()
        sys.exit(1)
    except OSError as error:
        if (trouble := disk_trouble(error)) is None:
            raise
        if error.filename is None:
            _leave_output()
        sys.exit(f"Error: {trouble}")
    except (RuntimeError, MemoryError) as error:
        if not ran_out_of_memory(error):
            raise
        sys.exit("Error: out of memory: give a smaller --size, or run on the CPU with CUDA_VISIBLE_DEVICES=")
    except KeyboardInterrupt:
        print("\nStopped; finished work is kept.", file=sys.stderr)
        sys.exit(130)


_TEXTS = "Texts follow --text: lang3dxl {} RUN --text windows{}"
_THINGS = "Single things, with their boxes: lang3dxl things RUN --text windows --out DIR"
_PLACES = (".scene", ".glb", ".spz", ".yml", ".ply", ".sog", ".splat", ".pt", ".ckpt")
"""Endings of what holds a scene or a splat."""
_REPEATED = ("--text", "--ask", "--not", "--segment", "--forget")
"""Options that take one text each time."""
_MANY = (*_REPEATED, "--at", "--not-at")
"""Options that may be given several times."""


def _parsed(words: Sequence[str]) -> Any:
    """Parse the words into the called command with its settings. Exits with a hint if they are not valid."""
    _check_no_empty(words)
    _check_name(COMMANDS, words)
    _check_once(words)
    words = with_place_as_taken(with_all_texts(words))
    try:
        config = (tyro.conf.OmitArgPrefixes,)
        parsed = tyro.cli(
            _choice(COMMANDS, words), prog="lang3dxl", args=words, description=__doc__, config=config
        )
    except SystemExit as error:
        if error.code == 2 and words[0] in ("query", "export"):
            told = _TEXTS.format(words[0], "" if words[0] == "query" else " --out found.ply")
            print(_THINGS if "--things" in words else told, file=sys.stderr)
        raise
    # Shells leave the ~ of --out=~/found as it is.
    vars(parsed).update({name: expanded(v) for name, v in vars(parsed).items() if isinstance(v, Path)})
    return parsed


def with_all_texts(words: Sequence[str]) -> list[str]:
    """Repeat --text, or another option of `_REPEATED`, before each further text, as people write `--text
    windows doors`. What names a file or folder is the scene and stays as it is. Raises UserError for what is
    written like one and is not there."""
    given, value, option = [], False, ""
    for word in words:
        if word.startswith("-"):
            value, option = word in _REPEATED, word
        elif value:
            value = False
        elif option in _REPEATED and not Path(word).exists():
            if ("/" in word and " " not in word) or Path(word).suffix.lower() in _PLACES:
                raise UserError(f"{word} does not exist: correct the name, or write {option} before a text")
            given.append(option)
        given.append(word)
    return given


_NAMED = {"train": ("--data",)} | dict.fromkeys(
    ("query", "things", "export", "teach", "words", "info", "view"), ("--scene", "--load-config")
)
"""Names that people give to the place that a command takes without one, such as those of nerfstudio."""


def with_place_as_taken(words: Sequence[str]) -> list[str]:
    """Spell the folder of photos, or the scene, as its command takes it: `train FOLDER`, `query SCENE`, but
    `reconstruct --data FOLDER`. People write either for all."""
    for name in _NAMED.get(next(iter(words), ""), ()):
        words = [word.removeprefix(f"{name}=") for word in words if word != name]
    named = words[:1] and words[0] in ("reconstruct", "prepare", "needs")
    if named and words[1:] and not words[1].startswith("-"):
        return [words[0], "--data", *words[1:]]
    return list(words)


def _check_no_empty(words: Sequence[str]) -> None:
    """Check that no word is empty. Raises UserError otherwise: as a path it would be the current folder."""
    for before, word in zip(("lang3dxl", *words), words, strict=False):
        if not word or (word.startswith("--") and word.endswith("=")):
            where = word.rstrip("=") or before
            raise UserError(f"what follows {where} is empty, as a variable that is not set: give a value")


def _check_once(words: Sequence[str]) -> None:
    """Check that no option has two values, of which the first would count for nothing. Raises UserError."""
    options = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    twice = [option for option in options if options.count(option) > 1 and option not in _MANY]
    if twice:
        raise UserError(f"{twice[0]} is given {options.count(twice[0])} times: give it once")


def _check_name(commands: Mapping[str, Any], words: Sequence[str], above: str = "lang3dxl") -> None:
    """Check that the first word is a command. Raises UserError with similar names if it is not."""
    if not words or words[0].startswith("-"):
        return
    if words[0] not in commands:
        similar = get_close_matches(words[0], commands, n=1)
        hint = f"did you mean {similar[0]}? " if similar else ""
        raise UserError(f"there is no command {above} {words[0]}: {hint}{above} --help lists all")
    if isinstance(found := commands[words[0]][0], Mapping):
        _check_name(found, words[1:], f"{above} {words[0]}")


def _leave_output() -> None:
    """Discard the unwritten output, so that Python does not report a broken pipe at exit."""
    with contextlib.suppress(OSError, ValueError):  # some streams have no file descriptor
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@dataclass
class _NotCalled:
    """Stands for a command that was not called."""


def _choice(commands: Mapping[str, Any], words: Sequence[str]) -> Any:
    """Build tyro's type for a choice of subcommands. Only the called one is imported: most need torch."""
    kinds = []
    for name, (place, summary) in commands.items():
        kind, described = _NotCalled, summary
        if words[:1] == [name]:
            group = isinstance(place, Mapping)
            kind = _choice(place, words[1:]) if group else settings_of(place)
            described = summary if group else None
        usual = {"default": kind.usual(words[1:])} if hasattr(kind, "usual") else {}
        kinds.append(Annotated[kind, tyro.conf.subcommand(name, description=described, **usual)])
    return reduce(operator.or_, kinds)


def settings_of(place: str) -> Any:
    """Import a command's settings class from `module:class` of the package or of the lab beside it. Raises
    UserError if it belongs to the lab, which is not installed here."""
    module, _, name = place.partition(":")
    if not module.startswith("lab."):
        module = f"lang3dxl_ns.{module}"
    elif not (LAB / "README.md").is_file():
        raise UserError(
            "this command comes with a checkout of the repository, not with the package: clone it, "
            "and install the clone with pip install -e"
        )
    return getattr(import_module(module), name)


@contextlib.contextmanager
def _terminable(ends: bool) -> Iterator[None]:
    """Let SIGTERM stop the command cleanly, like Ctrl-C. ends: whether the process ends after it."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    hook, sys.unraisablehook = sys.unraisablehook, _stop_again
    try:
        yield
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if ends:
            end_at_once()


def _stop_again(ignored: Any) -> None:
    """Raise a KeyboardInterrupt once more that Python ignored, as it does in finalizers and C's callbacks."""
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        threading.Timer(0.05, signal.raise_signal, [signal.SIGTERM]).start()  # shells may ignore SIGINT
    else:
        sys.__unraisablehook__(ignored)


if __name__ == "__main__":
    main()
