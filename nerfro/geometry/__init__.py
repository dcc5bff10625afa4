"""Meshes, grids made of them, and interpolation on grids."""
