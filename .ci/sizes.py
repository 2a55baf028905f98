"""Prints how large the code is, and fails where it is larger than agreed.

Lines by room, longest file, function lengths, docstrings, return types.

python .ci/sizes.py
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from pathlib import Path
from statistics import mean, median

PACKAGE = Path(__file__).parent.parent / "lang3dxl_ns"
TARGETS = {
    "lines of the package": 33_716,  # lower this whenever the package shrinks; docs/lab/size.md has the goal
    "median function": 10,
}
SHARES = {"public names with a docstring": 0.85, "functions with a return type": 0.95}


def main() -> None:
    lines: Counter[str] = Counter()
    longest = ("", 0)
    functions: list[int] = []
    typed: list[bool] = []
    documented: list[bool] = []
    imported: list[int] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_text()
        count = len(source.splitlines())
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        lines[room] += count
        longest = max(longest, (str(path.relative_to(PACKAGE)), count), key=lambda item: item[1])
        tree = ast.parse(source)
        imported.append(len(own_modules(tree)))
        for node, public in definitions(tree):
            if public:
                documented.append(ast.get_docstring(node) is not None)
            if not isinstance(node, ast.ClassDef):
                functions.append(node.end_lineno - node.lineno + 1)
                typed.append(node.returns is not None or node.name == "__init__")
    total = sum(lines.values())
    figures = {
        "lines of the package": total,
        "median function": median(functions),
    }
    for name, value in figures.items():
        print(f"{name:34} {value:>8,.0f}   (at most {TARGETS[name]:,})")
    shares = {"public names with a docstring": documented, "functions with a return type": typed}
    for name, values in shares.items():
        print(f"{name:34} {mean(values):>8.1%}   (at least {SHARES[name]:.0%})")
    wrong = [name for name, value in figures.items() if value > TARGETS[name]]
    wrong += [name for name, values in shares.items() if mean(values) < SHARES[name]]
    print(f"{'own modules that a module imports':34} {mean(imported):>8.1f}")
    print(f"{'longest file is':34} {longest[0]}")
    print("lines by room: " + ", ".join(f"{room} {count:,}" for room, count in lines.most_common()))
    if wrong:
        sys.exit(f"over the limit: {', '.join(wrong)}")


def definitions(tree: ast.Module, public: bool = True):
    """Functions, methods and classes, each with whether it is public; what is inside functions left out."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            shown = public and not node.name.startswith("_")
            yield node, shown
            if isinstance(node, ast.ClassDef):
                yield from definitions(node, shown)  # type: ignore[arg-type]


def own_modules(tree: ast.Module) -> set[str]:
    """Modules of the package that a module imports, anywhere in it."""
    nodes = (node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom))
    return {node.module for node in nodes if node.module and node.module.startswith("lang3dxl_ns")}


if __name__ == "__main__":
    main()
