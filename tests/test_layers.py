"""Layers: imports run down only, nerfstudio stays in the plugin, and loading is lazy."""

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # a dependency of pytest there

PACKAGE = Path(__file__).parent.parent / "lang3dxl_ns"


@cache
def nodes(source: str) -> list[ast.AST]:
    """All nodes of a module's tree, which several laws look at."""
    return list(ast.walk(ast.parse(source)))


@pytest.fixture(scope="module", autouse=True)
def forget_nodes():
    yield
    nodes.cache_clear()


def run(code: str) -> str:
    """Output of Python code run in a separate process."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def modules(*layers: str) -> list[str]:
    files = [path for layer in layers for path in (PACKAGE / layer).rglob("*.py")]
    return [
        ".".join(path.with_suffix("").relative_to(PACKAGE.parent).parts).removesuffix(".__init__")
        for path in files
    ]


ORDER = (
    {"common"},
    {"scene"},
    {"components", "rendering"},
    {"preparation"},
    {"query", "words", "files", "web", "things"},
    {"training"},
    {"attachment", "evaluation"},
    {"plugin"},
    {"methods", "open_scene"},
    {"commands"},
    {"cli"},
)
"""Packages from the bottom up: each imports only from its own layer and those below."""
MAY_IMPORT_NERFSTUDIO = {"plugin", "methods"}


def faults(source: str, room: str) -> list[str]:
    """Imports of `source`, a module of `room`, that go up, or reach for nerfstudio where it has no place."""
    floor = {name: i for i, names in enumerate(ORDER) for name in names}
    found = []
    for node in nodes(source):
        if isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            package, _, rest = name.partition(".")
            if package == "lang3dxl_ns" and rest and floor[rest.split(".")[0]] > floor[room]:
                found.append(f"{name} from {room}")
            if package == "nerfstudio" and room not in MAY_IMPORT_NERFSTUDIO:
                found.append(f"{name} from {room}")
    return found


def test_imports_run_down_and_nerfstudio_stays_in_the_plugin():
    found = {}
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).with_suffix("").parts[0]
        if room != "__init__" and (wrong := faults(path.read_text(), room)):
            found[str(path.relative_to(PACKAGE))] = wrong
    assert found == {}


@pytest.mark.parametrize(
    ("source", "room"),
    [
        ("from lang3dxl_ns.plugin.model import Lang3DXLModel", "query"),
        ("def late():\n    import lang3dxl_ns.commands.query", "plugin"),
        ("from nerfstudio.cameras.cameras import Cameras", "scene"),
    ],
)
def test_a_planted_upward_import_is_found(source, room):
    assert faults(source, room)


LAB_FROM = {"cli.py"}
"""Files that name modules of `lab`, which is no part of the package."""
NAMED = re.compile(r"(lab|commands)(\.\w+)+:\w+")


def named_places(source: str) -> set[str]:
    """Modules that a source reaches by strings, such as "lab.numerics.command:Numerics"."""
    texts = (n.value for n in nodes(source) if isinstance(n, ast.Constant))
    return {text for text in texts if isinstance(text, str) and NAMED.fullmatch(text)}


def test_strings_that_name_modules_lead_to_classes_and_only_the_command_line_names_the_lab():
    for path in PACKAGE.rglob("*.py"):
        for place in named_places(path.read_text()):
            module, _, name = place.partition(":")
            assert path.name in LAB_FROM, f"{path} reaches {place}"
            root = PACKAGE.parent if module.startswith("lab.") else PACKAGE
            tree = ast.parse((root / module.replace(".", "/")).with_suffix(".py").read_text()).body
            classes = {node.name for node in tree if isinstance(node, ast.ClassDef)}
            assigned = {ast.unparse(t) for node in tree if isinstance(node, ast.Assign) for t in node.targets}
            assert name in classes | assigned, place


def test_a_planted_string_is_found():
    assert named_places("x = 'lab.landmark.demo:Demo'") == {"lab.landmark.demo:Demo"}
    assert not named_places("x = 'a lab. with: text'")


STILL_ANY = {
    *("preparation/encoders.py model", "preparation/families.py model"),  # of transformers
    "scene/record.py file",  # from a file
    *("files/scene_file.py kind", "rendering/simd.py kind"),  # of NumPy and numba
    "plugin/run_settings.py settings",  # of any class
    *("plugin/wrong_flags.py settings", "training/fit.py settings"),
}
"""Names that are annotated Any although other modules use them for classes of this package."""


def notes(source: str) -> Iterator[tuple[str, ast.expr]]:
    """Names of parameters and fields, with their annotations."""
    for node in nodes(source):
        name = node.arg if isinstance(node, ast.arg) else None
        if isinstance(node, ast.AnnAssign):
            name = getattr(node.target, "id", getattr(node.target, "attr", None))
        if name and (note := getattr(node, "annotation", None)) is not None:
            yield name.strip("_"), note


def typed_any(sources: dict[str, str]) -> set[str]:
    """Modules and names that are annotated Any there, and with a class of these modules somewhere."""
    classes = {n.name for source in sources.values() for n in nodes(source) if isinstance(n, ast.ClassDef)}
    own, unknown = set(), set()
    for place, source in sources.items():
        for name, note in notes(source):
            kind = ast.unparse(note).removesuffix(" | None")
            if kind in classes:
                own.add(name)
            elif kind == "Any":
                unknown.add((place, name))
    return {f"{place} {name}" for place, name in unknown if name in own}


def test_no_further_class_of_our_own_is_typed_any():
    found = typed_any({p.relative_to(PACKAGE).as_posix(): p.read_text() for p in PACKAGE.rglob("*.py")})
    assert found == STILL_ANY, found ^ STILL_ANY


def test_a_planted_any_is_found():
    sources = {
        "a.py": "class Scene: ...\nclass Shown:\n    _scene: Scene | None\n    size: int\n",
        "b.py": "def f(scene: Any, size: Any): ...\n",
    }
    assert typed_any(sources) == {"b.py scene"}


def test_modules_that_import_each_other_do_not_exist():
    modules = {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
        for path in PACKAGE.rglob("*.py")
    }
    imports = {name: all_imports(path.read_text(), modules) - {name} for name, path in modules.items()}
    ready: set[str] = set()
    while new := {name for name in imports if name not in ready and imports[name] <= ready}:
        ready |= new
    assert set(imports) - ready == set()


def test_what_is_imported_is_declared():
    """Direct imports must not rely on transitive dependencies."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    declared = {re.match(r"[\w.-]+", line)[0].lower().replace("-", "_") for line in wanted}
    named_otherwise = {
        "PIL": "pillow",
        "cv2": "opencv_python_headless",
        "sklearn": "scikit_learn",
        "skimage": "scikit_image",
        "yaml": "pyyaml",
    }
    imported = set()
    for path in PACKAGE.rglob("*.py"):
        for node in nodes(path.read_text()):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module.split(".")[0])
            elif isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
    others = imported - set(sys.stdlib_module_names) - {"lang3dxl_ns"}
    assert {named_otherwise.get(name, name) for name in others} <= declared


def all_imports(source: str, modules) -> set[str]:
    """Modules of the package that a module imports anywhere: within functions and for type checkers too."""
    found = set()
    for node in nodes(source):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & set(modules)


def test_public_names_load_at_first_use_and_rooms_below_the_plugin_load_neither_nerfstudio_nor_cuda_code():
    below = ("common", "scene", "components", "rendering", "preparation", "query", "words", "files", "web")
    code = f"""
import importlib, json, sys, lang3dxl_ns
assert "torch" not in sys.modules
for name in {modules(*below, "evaluation", "training", "attachment")}: importlib.import_module(name)
print(json.dumps(sorted({{m.split(".")[0] for m in sys.modules}})))
assert all(getattr(lang3dxl_ns, name) is not None for name in lang3dxl_ns.__all__)
"""
    assert not {"nerfstudio", "gsplat", "tinycudann"} & set(json.loads(run(code).splitlines()[0]))


@pytest.mark.slow
@pytest.mark.nerfstudio
def test_the_entry_point_imports_no_heavy_library_and_other_methods_work_without_transformers(tmp_path):
    """nerfstudio's own imports aside, registering the methods loads no transformers (which is missing here)
    and no pycolmap."""
    missing = "print('transformers was asked for')\nraise ImportError('no transformers here')\n"
    (tmp_path / "transformers.py").write_text(missing)
    code = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
import nerfstudio.configs.method_configs
before = set(sys.modules)
import lang3dxl_ns.methods
print({{"pycolmap", "safetensors", "matplotlib.pyplot"}} & (set(sys.modules) - before))
print({{"lang3dxl", "lang3dxl-paper"}} <= set(nerfstudio.configs.method_configs.all_methods))
sys.argv = ["ns-train", "splatfacto", "--help"]
from nerfstudio.scripts.train import entrypoint
entrypoint()
"""
    said = run(code)
    assert said.startswith("set()\nTrue\n")
    assert "--pipeline.model.sh-degree" in said
