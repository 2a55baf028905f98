"""Static web page of a scene: splats in the browser, prompts answered beforehand as heat."""
