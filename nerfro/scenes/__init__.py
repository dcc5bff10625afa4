"""Synthetic scenes of refractive objects: modelled procedurally, rendered by a path tracer."""

SCENES = ("torus", "ship", "deerglobe", "starlamp")
