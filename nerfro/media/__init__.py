"""Refractive index: x -> (n, grad n)."""
