"""`torus`: a patterned torus inside a rounded glass cube, on a city square."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerfro.light import to_linear
from nerfro.scenes.patterns import chosen, hashed, mix
from nerfro.scenes.scene import Scene
from nerfro.scenes.skies import clouds, elevation, skyline, tiles
from nerfro.scenes.surface import Surface, rounded_box, torus_angles

HALF_SIDE, EDGE_RADIUS = 0.75, 0.08
MAJOR_RADIUS, MINOR_RADIUS = 0.38, 0.16
TILT_DEGREES = (35.0, 20.0)  # about x, then about y: the hole is seen from most sides

RIBBONS = np.array([[0.92, 0.30, 0.22], [0.98, 0.80, 0.24], [0.20, 0.56, 0.80], [0.96, 0.94, 0.88], [0.24, 0.70, 0.46]])
FACADES = np.array(
    [
        [0.80, 0.46, 0.33],
        [0.91, 0.82, 0.64],
        [0.42, 0.60, 0.62],
        [0.86, 0.66, 0.40],
        [0.70, 0.36, 0.36],
        [0.66, 0.68, 0.74],
    ]
)
PAVING = np.array([[0.62, 0.58, 0.52], [0.72, 0.50, 0.40], [0.45, 0.50, 0.54], [0.80, 0.76, 0.66]])


def torus_colours(angles: np.ndarray) -> np.ndarray:
    """Return sRGB colours [V, 3] of mosaic ribbons winding around the tube; `angles` [V, 2] as in `torus_angles`."""
    phi, theta = angles[:, 0] / (2 * np.pi), angles[:, 1] / (2 * np.pi)
    # Whole periods (5 ribbons, 8 steps) in both angles, so that the pattern closes on itself.
    across, along = 10 * phi + 5 * theta, 24 * phi - 8 * theta
    ribbon, step = np.floor(across).astype(int), np.floor(along).astype(int)
    colours = RIBBONS[ribbon % len(RIBBONS)]
    piece = hashed(np.stack([ribbon % len(RIBBONS), step % 8], -1), seed=3)
    colours = colours * (0.80 + 0.20 * piece)[:, None]
    seam = (np.abs(across - ribbon - 0.5) > 0.46) | (np.abs(along - step - 0.5) > 0.45)
    dot = np.hypot((across - ribbon - 0.5) * 1.2, along - step - 0.5) < 0.17
    colours = np.where(dot[:, None], chosen(RIBBONS, 1 - piece * 0.999), colours)
    return np.where(seam[:, None], np.array([0.20, 0.16, 0.20]), colours)


def sky(directions: np.ndarray) -> np.ndarray:
    """Return linear radiance [..., 3] of a square with houses under a cloudy sky."""
    colour = clouds(directions, horizon=(0.86, 0.90, 0.94), zenith=(0.30, 0.52, 0.86), cover=0.55, seed=11)
    houses, covered = skyline(directions, FACADES, count=26, heights=(7.0, 24.0), seed=5)
    colour = mix(colour, houses, covered)
    floor = tiles(directions, PAVING, size=0.34, grout=(0.30, 0.28, 0.27), fade=(0.62, 0.58, 0.54), seed=8)
    colour = mix(colour, floor, elevation(directions) < 0)
    return to_linear(np.clip(colour, 0.0, 1.0))


def tilted(surface: Surface, degrees: tuple[float, float]) -> Surface:
    """Return the surface turned about x, then about y."""
    (cx, cy), (sx, sy) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return replace(
        surface,
        vertices=(surface.vertices @ turn.T).astype(np.float32),
        normals=(surface.normals @ turn.T).astype(np.float32),
    )


def build(spacing: float) -> Scene:
    """Return the scene; `spacing` is the distance between neighbouring coloured vertices, world units."""
    ring, angles = torus_angles(MAJOR_RADIUS, MINOR_RADIUS, spacing)
    ring = replace(tilted(ring, TILT_DEGREES), colours=torus_colours(angles).astype(np.float32))
    glass = rounded_box((HALF_SIDE,) * 3, EDGE_RADIUS, edge_steps=12)
    return Scene(ior=1.5, glass=glass, interior=ring, sky=sky)
