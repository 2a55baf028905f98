"""Stability as a measured property: every component over a catalogue of extreme cases."""
