"""The landmarks that train the built-in encoders and those that score the method."""

from lab.clip_training.views import SPLITS
from lang3dxl_ns.benchmarks.landmarks import LANDMARKS, TEST, VALIDATION


def test_decision_published_and_training_landmarks_are_disjoint():
    assert not set(VALIDATION) & set(TEST) and len(LANDMARKS) == len(VALIDATION) + len(TEST)
    for landmarks, each in ((VALIDATION, 2), (TEST, 3)):
        families = sorted(family for _, family in landmarks.values())
        assert families == sorted(("cathedral", "hall", "mosque") * each)
    assert all(name == f"{family}-{seed}" for name, (seed, family) in LANDMARKS.items())
    for seed, _ in LANDMARKS.values():
        assert seed in SPLITS["test"]
    assert (
        min(seed for seed, _ in LANDMARKS.values()) >= 250
    )  # those below are reported in docs/lab/small_clip.md
