"""Numerical stability: every component measured on a catalog of extreme cases."""
