"""Point samplers, which choose arc lengths on paths."""
