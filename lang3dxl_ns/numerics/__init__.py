"""Numerical stability: every component measured on a catalogue of extreme cases."""
