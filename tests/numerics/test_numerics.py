"""Numerics: every hard case is within its bound, and the harness detects one that is not."""

import pytest
import torch
from numerics import compression, gathering, physical_scale, principal_basis, sharpening

from lab.numerics import catalog, command
from lab.numerics.command import measure_all
from lab.numerics.measure import Bounds, Case, Problem, measure
from lab.numerics.optimization import Run, runs
from lang3dxl_ns import cli

BOUNDS = {"float32": Bounds(), "bf16": Bounds(1e-2, 1e-2, 1e-2, 1e-2)}


def squares(distort=lambda out: out, **settings) -> Case:
    """x ↦ x², with a planted error."""

    def problem() -> Problem:
        x = torch.linspace(-1, 1, 24, dtype=torch.float64).view(4, 6, 1)
        return Problem(
            {"x": x},
            lambda leaves: {"out": distort(leaves["x"].square())},
            lambda leaves: {"out": leaves["x"] * leaves["x"]},
            **settings,
        )

    return Case("squares", "a case", problem, BOUNDS)


# Steps before and after training have no gradients; their cases are tests alone.
OTHERS = (physical_scale, principal_basis, gathering, sharpening, compression)


@pytest.mark.parametrize(
    "group", [*catalog.GROUPS, *OTHERS], ids=lambda group: group.__name__.rpartition(".")[2]
)
def test_every_hard_case_is_within_its_bound(group):
    rows = measure_all(list(group.cases(quick=True, device="cpu")), quick=True, device="cpu")
    assert rows
    assert [(row.case, row.mode, row.misses) for row in rows if row.misses] == []


def test_a_right_component_passes():
    assert measure(squares(), "float32").misses == []


@pytest.mark.parametrize(
    ("distort", "miss"),
    [
        (lambda out: out * 1.001, "output max"),
        (lambda out: out + 0.01 * (out - out.detach()), "gradient max"),
        (lambda out: torch.where(out > 0.9, torch.nan, out), "not finite"),
        (lambda out: out.detach(), "gradient rms"),
    ],
)
def test_a_wrong_component_misses(distort, miss):
    assert any(miss in found for found in measure(squares(distort), "float32").misses)


@pytest.mark.parametrize(
    "name", ["relevancy, usual", "downsampler, logits ±200, free", "loss: regions, usual", "squares, a case"]
)
def test_the_references_gradient_is_that_of_finite_differences(name):
    """References detach what they subtract for precision: a shift must not change the gradient."""
    cases = [*catalog.all_cases(quick=True, device="cpu"), squares()]
    problem = next(case for case in cases if f"{case.component}, {case.name}" == name).build()
    leaves = [value.requires_grad_() for value in problem.leaves.values()]

    def outputs(*values):
        return tuple(problem.reference(dict(zip(problem.leaves, values, strict=True))).values())

    assert torch.autograd.gradcheck(outputs, leaves, fast_mode=True)


def test_flipped_pixels_are_counted_and_left_out_of_the_gradient():
    def flip(out):
        return torch.cat([out[:1] * 1.01, out[1:]])

    strict = measure(squares(flip), "float32")
    row = measure(squares(flip, thresholds=True), "float32")
    assert row.flipped == pytest.approx(0.25)
    assert row.gradient_rms < 1e-6 < strict.gradient_rms
    assert any("flipped" in miss for miss in row.misses)


def test_long_and_stiff_optimizations_stay_finite_and_do_not_drift():
    assert [(run.name, run.misses) for run in runs(quick=True) if run.misses] == []


@pytest.mark.parametrize(
    ("changes", "miss"),
    [
        ({"finite": False}, "not finite"),
        ({"losses": [1.0, 0.5, 0.6]}, "loss 0.600, was 0.500"),
        ({"losses": [1.0, 0.5, float("nan")]}, "loss nan"),
        ({"codes": [1.0, 5.0, 90.0]}, "largest code 90.0 > 25"),
    ],
)
def test_an_optimization_that_drifts_misses(changes, miss):
    good = {"losses": [1.0, 0.6, 0.5], "codes": [1.0, 2.0, 3.0]}
    assert Run("a run", 30, True, **good).misses == []
    assert any(miss in found for found in Run("a run", 30, True, **good | changes).misses)


def test_a_miss_is_reported_in_words_and_makes_the_exit_code_1(tmp_path, monkeypatch, capsys):
    wrong = squares(lambda out: out * torch.where(out > 0.9, torch.inf, 1.001))
    monkeypatch.setattr(command, "all_cases", lambda quick, device: [wrong, squares()])
    broken = Run("fast", 30, True, losses=[1.0] * 10, codes=[1.0] * 10, finite=False)
    monkeypatch.setattr(command.optimization, "runs", lambda quick: [broken])
    with pytest.raises(SystemExit) as stop:
        cli.main(["numerics", "--out", str(tmp_path), "--quick"])
    assert stop.value.code == 1
    said = capsys.readouterr().out
    assert "MISS squares, a case, float32: not finite" in said
    assert "MISS optimization, fast: not finite" in said
    report = (tmp_path / "numerics.md").read_text()
    rows = [line for line in report.splitlines() if line.startswith("| squares")]
    assert ["**miss**" in row for row in rows] == [True, True, False, False]
    assert "**2 of 5 rows pass.**" in report
    assert f"`lang3dxl numerics --out {tmp_path} --quick`" in report
    assert (tmp_path / "numerics.png").read_bytes().startswith(b"\x89PNG")


def test_a_missing_library_is_named_before_anything_is_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "find_spec", lambda _: None)
    monkeypatch.setattr(command, "all_cases", lambda *_: pytest.fail("measured"))
    with pytest.raises(SystemExit, match=r"needs matplotlib: pip install -e '\.\[lab\]'"):
        cli.main(["numerics", "--out", str(tmp_path)])


def test_the_catalog_holds_every_group():
    components = {case.component for case in catalog.all_cases(quick=True, device="cpu")}
    assert {"appearance", "relevancy"} <= components
    assert {"rasterizer, torch", "hash grid", "decoder", "downsampler"} <= components
    on_gpu = {case.component for case in catalog.all_cases(quick=True, device="cuda")}
    assert "rasterizer, gsplat" in on_gpu
