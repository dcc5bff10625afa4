"""Path samplers, which turn rays into paths, and point samplers, which choose arc lengths on paths."""
