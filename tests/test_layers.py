"""The lower layers work without nerfstudio, and importing the plugin costs little and breaks nothing."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "lang3dxl_ns"


def run(code: str) -> str:
    """Output of Python code in a process of its own."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def modules(*layers: str) -> list[str]:
    files = [path for layer in layers for path in (PACKAGE / layer).rglob("*.py")]
    return [
        ".".join(path.with_suffix("").relative_to(PACKAGE.parent).parts).removesuffix(".__init__")
        for path in files
    ]


IMPORT_ALL = """
import importlib, json, sys
for name in {names}: importlib.import_module(name)
print(json.dumps(sorted({{m.split(".")[0] for m in sys.modules}})))
"""


def test_lower_layers_import_neither_nerfstudio_nor_cuda_code():
    loaded = json.loads(
        run(
            IMPORT_ALL.format(
                names=modules("components", "rendering", "preparation", "query", "evaluation", "baselines")
            )
        )
    )
    assert not {"nerfstudio", "gsplat", "tinycudann"} & set(loaded)


def test_torch_layers_import_nothing_of_the_layers_above():
    names = modules("components", "rendering")
    code = f"""
import importlib, sys
for name in {names}: importlib.import_module(name)
print([m for m in sys.modules if m.startswith("lang3dxl_ns.") and m.split(".")[1] in
       ("preparation", "query", "evaluation", "baselines", "demo")])
"""
    assert run(code).strip() == "[]"


@pytest.mark.slow
def test_entry_point_imports_no_heavy_library_of_its_own():
    """nerfstudio's own imports aside, registering the method loads no transformers and no pycolmap."""
    code = """
import sys
import nerfstudio.configs.method_configs
before = set(sys.modules)
import lang3dxl_ns.methods
print(sorted({"transformers", "pycolmap", "safetensors", "matplotlib.pyplot"} & (set(sys.modules) - before)))
"""
    assert run(code).strip() == "[]"


@pytest.mark.slow
def test_other_methods_work_with_transformers_missing(tmp_path):
    (tmp_path / "transformers.py").write_text("raise ImportError('no transformers here')\n")
    code = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
sys.argv = ["ns-train", "splatfacto", "--help"]
from nerfstudio.scripts.train import entrypoint
entrypoint()
"""
    assert "--pipeline.model.sh-degree" in run(code)


def test_public_names_load_at_first_use_and_not_before():
    code = """
import sys, lang3dxl_ns
assert "torch" not in sys.modules
print(all(getattr(lang3dxl_ns, name) is not None for name in lang3dxl_ns.__all__))
"""
    assert run(code).strip() == "True"
