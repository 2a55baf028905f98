"""Loading of a run's config.yml without executing code."""

from __future__ import annotations

import os
import re
import reprlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum, EnumMeta
from functools import cache
from math import isnan
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import Any, get_type_hints

import yaml
from typeguard import TypeCheckError, check_type

from lang3dxl_ns.common.errors import UserError, in_a_line
from lang3dxl_ns.common.files import read_text

TRUST_VARIABLE = "LANG3DXL_TRUST_CONFIG"
_PACKAGES = ("lang3dxl_ns", "nerfstudio", "torch.optim", "pathlib")
_OURS = re.compile(r"lang3dxl(_|%5f)ns\.|method_name\W+lang3dxl", re.IGNORECASE)
"""Pattern that marks a config.yml as this package's: one of its classes, or a method's name."""
_DAMAGED = (LookupError, TypeError, AttributeError, ValueError, RecursionError, ImportError)
"""Exceptions raised when settings are built from invalid values."""
_UNREAD = "camera_optimizer"
"""Setting that nothing reads, of another kind in runs until commit 1b7f663."""
_UNSAFE = {"MinimalDataParser", "MinimalDataParserConfig"}
"""Names of nerfstudio classes that unpickle what they read."""


def read_model_config(path: Path) -> tuple[Any, Path]:
    """Read the settings of a run's model, and the folder of its checkpoints, relative to the run's. This
    works as `read_settings`, but does not load what the other settings belong to. Settings that an earlier
    version did not have take their defaults, and the checkpoint beside the file shows whether those match."""
    model, checkpoints = read_settings(path, [("pipeline", "model"), ("relative_model_dir",)], complete=True)
    if not is_dataclass(model) or not isinstance(checkpoints, Path):
        raise no_config(path)
    return model, checkpoints


def read_settings(path: Path, places: Sequence[Sequence[str]], complete: bool = False) -> list[Any]:
    """Read settings from a run's config.yml. The file is parsed as data only: settings, paths, and classes by
    name from nerfstudio and this package (nerfstudio's own commands call whatever a file names).

    Each place is a path of names from the outermost in; () stands for all settings. The result is None where
    there are none. With `complete`, missing settings get their defaults. Raises UserError if the file is
    missing, damaged, or of another version, or requests more than settings.
    """
    try:
        found = _construct(read_text(path), places)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
        raise UserError(f"{path} is not a file: pass the config.yml of a run") from error
    except (yaml.YAMLError, OSError, *_DAMAGED) as error:
        raise UserError(
            f"{path} can't be read ({error}): it is damaged, or from a version of lang3dxl-ns whose settings "
            "are no longer known; restore it, open it with that version, or train anew"
        ) from error
    if odd := [line for part in found if is_dataclass(part) for line in _differences(part, complete)]:
        raise UserError(
            f"{path} {odd[0]}: it is truncated, or from another version of lang3dxl-ns; copy it again, open "
            "it with that version, or train anew"
        )
    return found


def _construct(text: str, places: Sequence[Sequence[str]]) -> list[Any]:
    loader = _SettingsLoader(text)
    try:
        root = loader.get_single_node()
        nodes = [_at(root, place) for place in places]
        return [None if node is None else loader.construct_document(node) for node in nodes]
    finally:
        loader.dispose()


def _at(node: yaml.Node | None, place: Sequence[str]) -> yaml.Node | None:
    for name in place:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        node = next((value for key, value in pairs if key.value == name), None)
    return node


def no_config(path: Path) -> UserError:
    """Return the error for a file that is not a run's config.yml."""
    return UserError(f"{path} is not the config.yml of a nerfstudio run")


def _differences(settings: Any, complete: bool, place: str = "") -> Iterator[str]:
    """Yield a description of each setting that a file lacks or should not have, by its dotted name. With
    `complete`, settings that it lacks get their defaults instead."""
    known = {field.name: field for field in fields(settings)}
    hints, own = _hints(type(settings)), set(vars(settings))  # type: ignore[arg-type]
    if not complete:
        yield from (f"lacks the setting {place}{name}" for name in sorted(known.keys() - own))
    yield from (f"has the unknown setting {place}{name}" for name in sorted(own - known.keys()))
    for name, field in sorted(known.items()):
        default = field.default if field.default_factory is MISSING else field.default_factory()
        if name not in own:
            vars(settings)[name] = default  # settings may be frozen
        value = getattr(settings, name)
        if name == "_target" and value is not default:
            yield f"would start {place}{name} {_begin(value)}"
        fits = name not in hints or _fits(value, hints[name]) or not _fits(default, hints[name])
        if not fits and name != _UNREAD:
            yield f"sets {place}{name} to {_begin(value)}, of another kind than this setting"
        elif is_dataclass(value) and not isinstance(value, type):
            yield from _differences(value, complete, f"{place}{name}.")


def _begin(value: Any) -> str:
    """Describe a value in a few letters: a file's aliases may stand for a list of any length."""
    return type(value).__name__ if is_dataclass(value) else reprlib.repr(value)[:40]


@cache
def _hints(settings: type) -> dict[str, Any]:
    try:
        return get_type_hints(settings)
    except NameError:  # a type that another package imports only for type checkers
        return {}


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value is of a setting's type, and not NaN."""
    try:
        check_type(value, hint)
    except TypeCheckError:
        return False
    return not (isinstance(value, float) and isnan(value))


def check_command_line(arguments: Sequence[str]) -> None:
    """Exit from an `ns-…` command whose `--load-config` file is a run of this method and holds more than
    settings, or cannot be checked before nerfstudio reads it (a pipe, or a device).

    nerfstudio calls whatever such a file names. It imports the methods first, the earliest moment at which a
    plugin can check. Files that do not name this package are left to nerfstudio.
    """
    for path in load_configs(arguments):
        if os.environ.get(TRUST_VARIABLE) != "1" and (why := _trouble(path)):
            sys.exit(
                f"Error: {path} {why}: nothing in it was run. If you trust its author, set {TRUST_VARIABLE}=1"
            )


def load_configs(arguments: Sequence[str]) -> Iterator[Path]:
    """Yield the files that a command's arguments name with --load-config."""
    for i, argument in enumerate(arguments):
        option, equals, value = argument.partition("=")
        if option.replace("_", "-") == "--load-config":
            path = Path(value if equals else "".join(arguments[i + 1 : i + 2]))
            if path.exists() and not path.is_dir():
                yield path


def _trouble(path: Path) -> str | None:
    """Return why a file may not be passed on to nerfstudio; None if it may."""
    try:
        text = read_text(path)
        if _OURS.search(text):
            _construct(text, [()])
    except (OSError, UnicodeError) as error:
        return f"can't be checked before it is used ({error})"
    except (yaml.constructor.ConstructorError, *_DAMAGED) as error:
        return f"holds more than settings ({in_a_line(error)})"
    except yaml.YAMLError:
        pass  # nerfstudio's command cannot read it either
    return None


class _SettingsLoader(yaml.UnsafeLoader):
    """YAML loader that constructs only settings, paths and enumeration members."""

    def find_python_name(self, name: str, mark: Any) -> Any:  # type: ignore[override]
        """Find a class in the packages that define settings."""
        if not name.startswith(tuple(f"{package}." for package in _PACKAGES)):
            raise yaml.constructor.ConstructorError(None, None, f"it asks for {name}", mark)
        found = super().find_python_name(name, mark)
        if not isinstance(found, type) or found.__name__ in _UNSAFE:
            why = f"it asks for {name}, which is no class of settings"
            raise yaml.constructor.ConstructorError(None, None, why, mark)
        return found

    def find_python_module(self, name: str, mark: Any) -> Any:  # type: ignore[override]
        """Reject modules, which settings never contain."""
        raise yaml.constructor.ConstructorError(None, None, f"it asks for the module {name}", mark)

    def make_python_instance(
        self, suffix: str, node: Any, args: Any = None, kwds: Any = None, newobj: bool = False
    ) -> Any:
        """Construct settings (without calling them), paths and enumeration members."""
        if suffix == "builtins.getattr" and len(args or ()) == 2 and isinstance(args[0], EnumMeta):
            return args[0][args[1]]  # Python 3.11.0 to 3.11.3, Debian's, writes members so
        kind = self.find_python_name(suffix, node.start_mark)
        if not (is_dataclass(kind) and newobj) and not issubclass(kind, PurePath | Enum):
            raise yaml.constructor.ConstructorError(None, None, f"it asks to call {suffix}", node.start_mark)
        if issubclass(kind, PurePath):  # paths of the system on which the run was made
            written = PureWindowsPath if issubclass(kind, PureWindowsPath) else PurePosixPath
            return Path(written(*args).as_posix())
        return super().make_python_instance(suffix, node, args, kwds, newobj)
