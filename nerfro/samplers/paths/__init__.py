"""Path samplers: straight rays, refraction at surfaces, and integration through a continuous index."""
