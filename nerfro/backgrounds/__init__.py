"""Background models: background radiance as a function of the exits of paths."""
