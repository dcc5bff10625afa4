"""Synthetic scenes of refractive objects: modelled procedurally by plugins, rendered by a path tracer."""

SCENES: dict[str, str] = {}
"""Module of each scene, by name; plugins add scenes. `build(spacing)` of the module returns the `Scene`."""
