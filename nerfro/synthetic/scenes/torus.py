"""`torus`: a patterned torus inside a rounded glass cube, on a city square."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerfro.core.light import to_linear
from nerfro.synthetic.scene import SyntheticScene, rounded_box, torus_angles
from nerfro.synthetic.scenes.patterns import chosen, clouds, elevation, hashed, mix, skyline, smoothstep

HALF_SIDE, EDGE_RADIUS = 0.75, 0.08
MAJOR_RADIUS, MINOR_RADIUS = 0.38, 0.16
TILT_DEGREES = (35.0, 20.0)  # about x, then about y: the hole is seen from most sides

RIBBONS = np.array([[0.92, 0.30, 0.22], [0.98, 0.80, 0.24], [0.20, 0.56, 0.80], [0.96, 0.94, 0.88], [0.24, 0.70, 0.46]])
FACADES = np.array(
    [[0.8, 0.46, 0.33], [0.91, 0.82, 0.64], [0.42, 0.6, 0.62], [0.86, 0.66, 0.4], [0.7, 0.36, 0.36], [0.66, 0.68, 0.74]]
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
    colour = mix(colour, _paving(directions), elevation(directions) < 0)
    return to_linear(np.clip(colour, 0.0, 1.0))


def _paving(directions: np.ndarray) -> np.ndarray:
    depth = np.maximum(-directions[..., 2], 1e-3)
    tiles = directions[..., :2] / depth[..., None] / 0.34
    cell = np.floor(tiles).astype(np.int64)
    inside = np.abs(tiles - cell - 0.5).max(-1) < 0.46
    checker = ((cell.sum(-1) % 2) == 0)[..., None]
    colour = chosen(PAVING, hashed(cell, 8))
    colour = np.where(checker, colour, 0.25 + 0.6 * colour)
    colour = np.where(inside[..., None], colour, np.array([0.30, 0.28, 0.27]))
    # Fades towards the horizon before the tiles are finer than a pixel.
    return mix(np.array([0.62, 0.58, 0.54]), colour, smoothstep(0.04, 0.24, depth))


def build(spacing: float) -> SyntheticScene:
    """Return the scene; `spacing` is the distance between neighbouring coloured vertices, world units."""
    ring, angles = torus_angles(MAJOR_RADIUS, MINOR_RADIUS, spacing)
    (cx, cy), (sx, sy) = np.cos(np.radians(TILT_DEGREES)), np.sin(np.radians(TILT_DEGREES))
    turn = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    vertices, normals = ((array @ turn.T).astype(np.float32) for array in (ring.vertices, ring.normals))
    ring = replace(ring, vertices=vertices, normals=normals, colours=torus_colours(angles).astype(np.float32))
    glass = rounded_box((HALF_SIDE,) * 3, EDGE_RADIUS, edge_steps=12)
    return SyntheticScene(ior=1.5, glass=glass, interior=ring, sky=sky)
