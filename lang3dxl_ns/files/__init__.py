"""Files of scenes: our own format, splats of every program, and runs."""
