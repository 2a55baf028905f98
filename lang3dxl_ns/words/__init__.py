"""Words that a scene was taught by example."""
