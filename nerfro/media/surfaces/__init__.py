"""Surfaces of bodies: balls, boxes, bodies of revolution, distances in files, and offsets of other surfaces."""

from nerfro.media.surfaces import ball, box, grid, offset, revolution  # noqa: F401 - registers the surfaces
