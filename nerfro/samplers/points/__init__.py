"""Where paths are sampled."""
