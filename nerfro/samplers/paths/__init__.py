"""How rays become paths: straight, refracted, or integrated through a continuous index."""
