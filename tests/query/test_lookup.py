"""Laws of the lookup table: exact where the decoder is, silent where it knows nothing."""

import pytest
import torch

from lang3dxl_ns.components.semantic_field import SemanticField, SemanticFieldConfig
from lang3dxl_ns.query.lookup import (
    CodeScorer,
    CodeTable,
    Lookup,
    LookupConfig,
    mark_cells,
    table_error,
    tabulate,
)
from lang3dxl_ns.query.relevancy import Queries, relevancy_of_codes

CHANNELS = 24


@pytest.fixture
def queries():
    generator = torch.Generator().manual_seed(1)
    prompts = [torch.randn(n, CHANNELS, generator=generator) for n in (1, 3)]
    return Queries.of(prompts, torch.randn(4, CHANNELS, generator=generator))


def some_codes(count: int = 4000, dims: int = 3, spread: float = 1.0) -> torch.Tensor:
    """Two clusters, so that most of the box between them is empty."""
    generator = torch.Generator().manual_seed(2)
    codes = 0.3 * spread * torch.randn(count, dims, generator=generator)
    codes[::2] += 2 * spread
    return codes


def build_table(decode, codes: torch.Tensor, size: int, bounded: bool) -> CodeTable:
    return tabulate(decode, mark_cells(codes, size, bounded))


def smooth(codes: torch.Tensor) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    a, b = (torch.randn(codes.shape[1], CHANNELS, generator=generator) for _ in range(2))
    return torch.sin(codes @ a.to(codes)) + torch.cos(codes @ b.to(codes)) + 0.5


@pytest.mark.parametrize("dims", [2, 3, 4])
@pytest.mark.parametrize("bounded", [True, False])
def test_vertices_are_exact(queries, dims, bounded):
    """Codes at the vertices themselves: nothing is interpolated, only half precision is left."""
    table = build_table(smooth, some_codes(500, dims), 16, bounded)
    cells = (table.cell_of >= 0).nonzero()[:, 0]
    corner = torch.stack([cells // 16**axis % 16 for axis in reversed(range(dims))], dim=1)
    places = table.low + corner * (table.extent / 16)
    codes = places.clamp(1e-6, 1 - 1e-6).logit() if bounded else places
    read, known = table.read(codes, table.cosines(queries.vectors))
    # A vertex may round to the cell before it, which need not be one of the reached.
    assert known.float().mean() > 0.5
    torch.testing.assert_close(read[known], queries.cosines(smooth(codes[known])), atol=2e-3, rtol=0)


def test_finer_tables_err_less(queries):
    codes = some_codes()
    exact = relevancy_of_codes(smooth, codes, queries)
    errors = [
        table_error(
            exact, CodeScorer(smooth, build_table(smooth, codes, size, True)).relevancy(codes, queries)
        )
        for size in (4, 16, 64)
    ]
    assert errors[0].mean > 3 * errors[1].mean > 9 * errors[2].mean
    assert errors[2].p999 < 0.02


def test_every_code_that_was_rendered_is_in_the_table_and_far_ones_are_not():
    codes = some_codes()
    table = build_table(smooth, codes, 32, True)
    assert table.locate(codes)[2].all()
    nearby = codes + 0.3 * table.extent / 32
    assert table.locate(nearby)[2].all()
    strange = torch.tensor([[50.0, 0, 0], [1.0, 1.0, 1.0], [float("nan"), 0, 0], [float("inf"), 0, 0]])
    assert not table.locate(strange)[2].any()
    assert len(table.corners) < 0.5 * 32**3


def test_codes_outside_the_table_are_decoded(queries):
    codes = some_codes()
    scorer = CodeScorer(smooth, build_table(smooth, codes, 16, True))
    outside = torch.full((2, 5, 3), 9.0)
    torch.testing.assert_close(
        scorer.relevancy(outside, queries), relevancy_of_codes(smooth, outside, queries)
    )
    mixed = torch.cat([codes[:10], outside[0], codes[10:20]])
    parts = [scorer.relevancy(part, queries) for part in (codes[:10], outside[0], codes[10:20])]
    torch.testing.assert_close(scorer.relevancy(mixed, queries), torch.cat(parts, dim=1))


def test_what_is_not_kept_scores_zero_and_changes_nothing_else(queries):
    codes = some_codes(60).reshape(6, 10, 3)
    keep = torch.arange(60).reshape(6, 10) % 3 > 0
    scorer = CodeScorer(smooth)
    scores, whole = scorer.relevancy(codes, queries, keep), scorer.relevancy(codes, queries)
    assert (scores[:, ~keep] == 0).all()
    torch.testing.assert_close(scores[:, keep], whole[:, keep])
    for empty in (scorer, CodeScorer(smooth, build_table(smooth, some_codes(), 8, True))):
        assert (empty.relevancy(codes, queries, torch.zeros_like(keep)) == 0).all()


def test_the_largest_competitor_is_taken_after_interpolation(queries):
    """Between two vertices whose best competitors differ, a maximum taken first would be too large."""
    table = build_table(smooth, some_codes(), 4, True)
    cosines = table.cosines(queries.vectors)
    read, _ = table.read(some_codes(), cosines)
    early, _ = table.read(some_codes(), cosines[:, list(queries.negative[0])].amax(1, keepdim=True))
    late = read[:, list(queries.negative[0])].amax(1)
    assert (late <= early[:, 0] + 1e-6).all() and (late < early[:, 0] - 1e-3).any()
    expected = queries.relevancy_of_cosines(read)
    torch.testing.assert_close(CodeScorer(smooth, table).relevancy(some_codes(), queries), expected)


def test_another_text_gets_another_answer_from_the_same_table(queries):
    table = build_table(smooth, some_codes(), 8, True)
    first, second = table.cosines(queries.vectors), table.cosines(-queries.vectors)
    torch.testing.assert_close(first, -second)
    assert torch.equal(table.cosines(queries.vectors), first)


def test_the_coarsest_table_that_is_good_enough_is_chosen(queries):
    def choose(tolerance, **limits):
        config = LookupConfig(sizes=(4, 16, 64), tolerance=tolerance, **limits)
        return Lookup.build(smooth, some_codes(), queries, True, config)

    generous, strict, impossible, small = choose(1.0), choose(0.03), choose(1e-9), choose(1.0, max_mb=1e-3)
    assert generous.table.size == 4
    assert strict.table.size > 4 and strict.checks[-1].error.p999 <= 0.03
    assert strict.checks[-1].decoded <= 0.1 < strict.checks[0].decoded
    assert impossible.table is None and len(impossible.checks) == 3
    assert "every code is decoded" in str(impossible)
    assert small.table is None and small.checks == []  # told before anything is decoded


def test_where_the_decoder_bends_sharply_codes_are_decoded(queries):
    def kinked(codes):
        """Smooth, but for a wall at 0 that a few codes are near to."""
        return smooth(codes) + 2 * torch.tanh(200 * codes[:, :1]) * queries.vectors[4]

    codes = some_codes()
    codes[:, 0] += 0.4
    exact = relevancy_of_codes(kinked, codes, queries)
    plain, careful = (build_table(kinked, codes, 64, True) for _ in range(2))
    careful.leave_out_rough_cells(kinked, queries, tolerance=0.03)
    errors = [table_error(exact, CodeScorer(kinked, t).relevancy(codes, queries)) for t in (plain, careful)]
    assert errors[0].p999 > 0.05 and errors[1].p999 < 0.03
    assert 0 < (~careful.locate(codes)[2]).float().mean() < 0.1
    torch.testing.assert_close(careful.locate(torch.tensor([[0.001, 0.0, 0.0]]))[2], torch.tensor([False]))


def test_a_scene_that_shows_nothing_has_no_table(queries):
    assert Lookup.build(smooth, torch.zeros(0, 3), queries, True, LookupConfig()).table is None


def test_a_single_code_makes_a_table_all_the_same(queries):
    table = build_table(smooth, torch.zeros(1, 3), 8, True)
    assert table.locate(torch.zeros(1, 3))[2].all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_real_field_tabulates(dtype, queries):
    generator = torch.Generator().manual_seed(0)
    field = SemanticField(SemanticFieldConfig(preset="short"), CHANNELS, 0, generator=generator).to(dtype)
    codes = some_codes().to(dtype)
    queries = Queries(queries.vectors.to(dtype), queries.positive, queries.negative)
    scorer = CodeScorer(field.decode_clip, build_table(field.decode_clip, codes, 64, True))
    exact = relevancy_of_codes(field.decode_clip, codes, queries)
    assert scorer.relevancy(codes, queries).dtype == dtype
    assert table_error(exact, scorer.relevancy(codes, queries)).p999 < 0.06  # random weights are rough


def test_errors_of_known_maps():
    exact = torch.full((1, 1000), 0.4)
    other = exact.clone()
    other[0, 0] = 0.6
    error = table_error(exact, other)
    assert error.mean == pytest.approx(0.0002) and error.p999 == 0 and error.flips == pytest.approx(0.001)
