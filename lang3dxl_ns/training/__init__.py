"""Training: from a capture to a scene."""
