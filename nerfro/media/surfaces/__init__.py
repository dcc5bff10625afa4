"""Surfaces of bodies: balls, boxes, bodies of revolution, distances in files, and offsets of other surfaces."""
