"""Encoders of the systems that the method is compared with, behind the semantic field's own interface."""
