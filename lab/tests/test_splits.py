"""The landmarks that train the built-in encoders and those that score the method."""

from lab.clip_training.views import SPLITS
from lang3dxl_ns.benchmarks.landmarks import LANDMARKS, TEST, VALIDATION


def test_decision_published_and_training_landmarks_are_disjoint():
    assert not set(VALIDATION) & set(TEST) and len(LANDMARKS) == len(VALIDATION) + len(TEST)
    assert sorted(family for _, family in VALIDATION.values()) == sorted(("cathedral", "hall", "mosque") * 2)
    for seed, _ in LANDMARKS.values():
        assert seed in SPLITS["test"]
    assert (
        min(seed for seed, _ in VALIDATION.values()) >= 250
    )  # those below are reported in docs/lab/small_clip.md
