"""Synthetic scenes of refractive objects: modelled procedurally, rendered by a path tracer."""

SCENES: dict[str, str] = {"torus": "nerfro.scenes.torus"}
"""Module of each scene, by name; plugins add scenes. `build(spacing)` of the module returns the `Scene`."""
