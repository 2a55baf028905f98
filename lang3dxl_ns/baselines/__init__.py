"""Baselines from the literature, which implement the semantic field's interface."""
