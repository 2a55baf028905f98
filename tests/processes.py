"""Commands in processes of their own that begin with the libraries loaded: forks of a server that has them.

    run("ns-eval", "--load-config", config, cwd=folder)       # a second, where a shell needs ten
    run("ns-eval", "--load-config", config, cwd=folder, shell=True)

Arguments, folder, environment, output, exit code and signals are a process's own either way. What only a true
start shows (that the command is installed, which modules it imports) wants `shell=True`, once per command.
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import entry_points
from multiprocessing import forkserver, resource_tracker, util
from pathlib import Path
from typing import Any
from unittest import mock

SERVER = multiprocessing.get_context("forkserver")
_LIBRARIES = [
    "numpy",  # before pycolmap
    "lang3dxl_ns.cli",
    "lang3dxl_ns.plugin.load_scene",
    "nerfstudio.scripts.train",
    "nerfstudio.scripts.eval",
    "nerfstudio.scripts.render",
    "nerfstudio.scripts.exporter",
    "nerfstudio.scripts.viewer.run_viewer",
    "pycolmap",
    "transformers.models.clip.modeling_clip",
    "transformers.models.clip.tokenization_clip",
    "transformers.models.dinov2.modeling_dinov2",
]


def start_server() -> None:
    """Start the server as a fork of this process, where collecting the tests has imported nearly all of the
    libraries; before the first test, so that it inherits nothing of any."""
    resource_tracker.ensure_running()
    with mock.patch.object(util, "spawnv_passfds", _fork):
        forkserver.ensure_running()


def _fork(_path: str, _arguments: list[str], descriptors: list[int]) -> int:
    """What `ensure_running` starts by a new interpreter: the server, with these files alone open."""
    if pid := os.fork():
        return pid
    try:
        kept = sorted(descriptors)
        for last, following in zip([2, *kept], [*kept, os.sysconf("SC_OPEN_MAX")], strict=True):
            os.closerange(last + 1, following)
        forkserver.main(*descriptors, _LIBRARIES)
    finally:  # at the end of the tests, which it learns by SystemExit
        os._exit(0)


class Process:
    """A function of a module, running in a process of its own, with its output in files."""

    def __init__(
        self,
        function: Callable[..., Any],
        *arguments: Any,
        cwd: Path | None = None,
        new_session: bool = False,
    ) -> None:
        self._folder = tempfile.TemporaryDirectory()
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "COLUMNS": "200"}
        place = (self._folder.name, str(cwd or os.getcwd()), environment, new_session)
        self._process = SERVER.Process(target=_within, args=(place, function, arguments))
        self._process.start()
        assert self._process.pid is not None
        self.pid: int = self._process.pid

    def send_signal(self, number: signal.Signals) -> None:
        os.kill(self.pid, number)

    def poll(self) -> int | None:
        """The exit code once it has ended, as of `subprocess`: negative for a signal."""
        return self._process.exitcode

    @property
    def stdout(self) -> str:
        """What it has written so far."""
        return Path(self._folder.name, "stdout").read_text()

    @property
    def stderr(self) -> str:
        return Path(self._folder.name, "stderr").read_text()

    def wait(self, timeout: float = 300) -> subprocess.CompletedProcess[str]:
        """Its end. Raises TimeoutError, after killing it, where that is long in coming."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            self._process.kill()
            raise TimeoutError(self.stdout[-3000:] + self.stderr[-3000:])
        return subprocess.CompletedProcess([], self._process.exitcode, self.stdout, self.stderr)


def start(*words: object, cwd: Path | None = None, new_session: bool = False) -> Process:
    """Start an installed command, such as `ns-train`."""
    return Process(_command, *map(str, words), cwd=cwd, new_session=new_session)


def run(
    *words: object, cwd: Path | None = None, shell: bool = False, timeout: float = 600
) -> subprocess.CompletedProcess[str]:
    """A command, run to its end, whatever that is: from the server, or (`shell`) as a shell starts it."""
    if not shell:
        return start(*words, cwd=cwd).wait(timeout)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "HF_HUB_OFFLINE": "1", "COLUMNS": "200"}
    return subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=timeout,
    )


def output(*words: object, cwd: Path | None = None, shell: bool = False, timeout: float = 600) -> str:
    """What a command writes, which has to succeed."""
    done = run(*words, cwd=cwd, shell=shell, timeout=timeout)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout + done.stderr


def _command(*words: str) -> None:
    """What the script of an installed command does."""
    (script,) = entry_points(group="console_scripts", name=words[0])
    sys.argv = list(words)
    sys.exit(script.load()())


def _within(
    place: tuple[str, str, dict[str, str], bool], function: Callable[..., Any], arguments: tuple[Any, ...]
) -> None:
    """In the new process: its own folder, environment and output, and an end like Python's own."""
    folder, cwd, environment, new_session = place
    multiprocessing.set_start_method(None, force=True)  # else it would be the forkserver for what it starts
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    if new_session:
        os.setsid()
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(Path(folder, name), os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
        setattr(sys, name, os.fdopen(number, "w", buffering=1, closefd=False))
    try:
        function(*arguments)
    except SystemExit:
        raise
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        if not isinstance(error, KeyboardInterrupt):
            sys.exit(1)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    finally:
        atexit._run_exitfuncs()
