"""A run's config.yml, read without running what stands in it."""

from __future__ import annotations

from dataclasses import is_dataclass
from enum import Enum
from pathlib import Path, PurePath
from typing import Any

import yaml
from nerfstudio.engine.trainer import TrainerConfig

from lang3dxl_ns.errors import UserError

_PACKAGES = ("lang3dxl_ns", "nerfstudio", "torch.optim", "pathlib")


def read_config(path: Path) -> TrainerConfig:
    """The configuration of a run. Only data is made of the file: settings, paths, and classes by name of
    nerfstudio and this package (nerfstudio's own commands call whatever a file asks for).

    Raises UserError for a missing or damaged file, one of another version, and one that asks for more.
    """
    try:
        config = yaml.load(path.read_text(), Loader=_SettingsLoader)
    except FileNotFoundError as error:
        raise UserError(f"{path} is not a file: pass the config.yml of a run") from error
    except (yaml.YAMLError, OSError, LookupError, TypeError, AttributeError, ValueError) as error:
        raise UserError(
            f"{path} can't be read ({error}): it is damaged, or of a version whose settings are not known "
            "any more; restore it, or train anew"
        ) from error
    if not isinstance(config, TrainerConfig):
        raise UserError(f"{path} is not the config.yml of a run of nerfstudio")
    return config


class _SettingsLoader(yaml.UnsafeLoader):
    """Makes settings and paths, and nothing else."""

    def find_python_name(self, name: str, mark: Any) -> Any:  # type: ignore[override]
        """A class of the packages that settings come from."""
        if not name.startswith(tuple(f"{package}." for package in _PACKAGES)):
            raise yaml.constructor.ConstructorError(None, None, f"it asks for {name}", mark)
        found = super().find_python_name(name, mark)
        if not isinstance(found, type):
            raise yaml.constructor.ConstructorError(
                None, None, f"it asks for {name}, which is no class", mark
            )
        return found

    def find_python_module(self, name: str, mark: Any) -> Any:  # type: ignore[override]
        """Settings hold no modules."""
        raise yaml.constructor.ConstructorError(None, None, f"it asks for the module {name}", mark)

    def make_python_instance(
        self, suffix: str, node: Any, args: Any = None, kwds: Any = None, newobj: bool = False
    ) -> Any:
        """Settings, without calling them, paths and members of enumerations."""
        kind = self.find_python_name(suffix, node.start_mark)
        if not (is_dataclass(kind) and newobj) and not issubclass(kind, PurePath | Enum):
            raise yaml.constructor.ConstructorError(None, None, f"it asks to call {suffix}", node.start_mark)
        return super().make_python_instance(suffix, node, args, kwds, newobj)
