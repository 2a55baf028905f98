"""Numerical stability: components measured on a catalog of extreme cases."""
