"""Spherical vessels: as a medium, and their rays by formulas for spheres and a plane in double precision."""

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from nerfro.media.bodies import Bodies
from nerfro.media.vessel import make_vessel

RADIUS, WALL = 0.8, 0.1
GLASS, WATER = 1.5, 1.333


def spherical_vessel(folder: Path, subdivisions: int = 5, **options: object) -> Bodies:
    """A closed one, its lowest point at z = -RADIUS."""
    file = folder / "ball.ply"
    trimesh.creation.icosphere(subdivisions, RADIUS).export(file)
    known = {"wall": WALL, "closed": True, "ior": GLASS, "liquid_ior": WATER, "resolution": 96, "cache": False,
             "box_min": [-0.9] * 3, "box_max": [0.9] * 3}  # fmt: skip
    return make_vessel(str(file), **known | options)


def exit_direction(
    x: Float[np.ndarray, "3"], d: Float[np.ndarray, "3"], wall: float, surface: float | None, max_events: int = 16
) -> tuple[Float[np.ndarray, "3"], int]:
    """Where a ray that starts outside leaves a spherical vessel, by intersecting spheres and a plane; and its events.

    Args:
        x, d: origin and unit direction.
        wall: thickness.
        surface: height z of the liquid's surface; None for a full vessel.
        max_events: of which the last is reached where the ray does not leave before.
    """
    inner = RADIUS - wall

    def index(p: np.ndarray) -> float:
        if p @ p > RADIUS**2:
            return 1.0
        if p @ p > inner**2:
            return GLASS
        return WATER if surface is None or p[2] < surface else 1.0

    for events in range(max_events):
        hits = []
        for radius in (RADIUS, inner):
            b, c = x @ d, x @ x - radius**2
            if b * b > c:
                hits += [(-b + sign * np.sqrt(b * b - c), radius) for sign in (-1, 1)]
        if surface is not None and d[2] != 0:
            hits.append(((surface - x[2]) / d[2], 0.0))  # of no radius, the plane
        ahead = ((length, of) for length, of in sorted(hits, key=lambda hit: hit[0]) if length > 1e-9)
        both = ((index(x + (length - 1e-9) * d), index(x + (length + 1e-9) * d), length, of) for length, of in ahead)
        hit = next((hit for hit in both if hit[0] != hit[1]), None)
        if hit is None:
            return d, events
        n_before, n_after, length, radius = hit
        x = x + length * d
        normal = np.array([0.0, 0.0, 1.0]) if radius == 0 else x / np.linalg.norm(x)
        cosine = -(normal @ d)
        if cosine < 0:
            normal, cosine = -normal, -cosine
        ratio = n_before / n_after
        squared = 1 - ratio**2 * (1 - cosine**2)
        d = d + 2 * cosine * normal if squared <= 0 else ratio * d + (ratio * cosine - np.sqrt(squared)) * normal
        d = d / np.linalg.norm(d)
    return d, max_events


def exit_directions(
    origins: Float[np.ndarray, "R 3"], directions: Float[np.ndarray, "R 3"], wall: float, surface: float | None
) -> tuple[Float[np.ndarray, "R 3"], Bool[np.ndarray, "R"]]:
    """Exit directions, and which rays left."""
    found = [exit_direction(x, d, wall, surface) for x, d in zip(origins, directions, strict=True)]
    return np.stack([d for d, _ in found]), np.array([events < 16 for _, events in found])
