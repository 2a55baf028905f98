"""Static web page of a scene: splats in the browser, and prompts answered as heat."""
