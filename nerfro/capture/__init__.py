"""Optics of a photographed object: surroundings, refractive index, and refinement of the surface."""
