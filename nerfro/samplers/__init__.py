"""How rays become paths, and where paths are sampled."""
