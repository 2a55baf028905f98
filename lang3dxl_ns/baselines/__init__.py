"""Baselines from the literature, behind the semantic field's interface."""
