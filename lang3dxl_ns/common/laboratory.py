"""The repository's `lab` folder, which a checkout has beside the package and a wheel has not."""

from __future__ import annotations

from pathlib import Path

import lang3dxl_ns


def has_laboratory() -> bool:
    """Whether `import lab` finds the programs that come with a checkout."""
    return (Path(lang3dxl_ns.__file__).parents[1] / "lab" / "README.md").is_file()
