"""The landmarks that train the built-in encoders and those that score the method."""

from lab.benchmarks.landmarks import SEEDS
from lab.clip_training.views import SPLITS


def test_decision_published_and_training_landmarks_are_disjoint():
    for families, each in ((SEEDS["validation"], 2), (SEEDS["test"], 3)):
        assert {family: len(seeds) for family, seeds in families.items()} == dict.fromkeys(
            ("cathedral", "mosque", "hall"), each
        )
    seeds = [seed for families in SEEDS.values() for own in families.values() for seed in own]
    assert len(set(seeds)) == len(seeds)
    assert all(seed in SPLITS["test"] for seed in seeds)
    assert min(seeds) >= 250  # those below are reported in docs/lab/small_clip.md
