"""Path samplers: straight rays and refraction at surfaces."""
