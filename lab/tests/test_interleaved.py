"""Candidates are timed in turn."""

from lab.benchmarks.interleaved import interleaved_times


def test_candidates_run_in_turn_and_the_warm_up_is_left_out():
    calls = []
    times = interleaved_times({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, repeats=3)
    assert calls == ["a", "b"] * 4
    assert {name: len(taken) for name, taken in times.items()} == {"a": 3, "b": 3}


def test_a_candidate_over_its_budget_stops_and_keeps_what_it_has():
    now = [0.0]

    def taking(seconds):
        return lambda: now.__setitem__(0, now[0] + seconds)

    candidates = {"quick": taking(1), "slow": taking(4), "slower": taking(30)}
    times = interleaved_times(candidates, repeats=5, budget_seconds=10, clock=lambda: now[0])
    assert times == {"quick": [1] * 5, "slow": [4, 4, 4], "slower": [30]}
