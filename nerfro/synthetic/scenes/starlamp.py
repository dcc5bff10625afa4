"""`starlamp`: a five-pointed star of glass around a ringed planet, in a room with a bookcase and windows."""

from __future__ import annotations

import functools

import numpy as np

from nerfro.core.light import to_linear
from nerfro.synthetic.scene import SyntheticScene, join
from nerfro.synthetic.scenes import distance
from nerfro.synthetic.scenes.patterns import chosen, fractal_noise, hashed, mix, smoothstep

OUTER, INNER, HALF_DEPTH, ROUNDING = 0.84, 0.44, 0.34, 0.10
PLANET_RADIUS, RING_RADII = 0.21, (0.27, 0.37)
AXIS = np.array([0.20, -0.82, 0.53]) / np.linalg.norm([0.20, -0.82, 0.53])  # the ring lies nearly in the star's plane
ROOM_LOW, ROOM_HIGH = np.array([-1.7, -1.4, -1.0]), np.array([1.7, 1.4, 1.2])
BOOKS = np.array(
    [[0.7, 0.2, 0.18], [0.16, 0.33, 0.52], [0.88, 0.7, 0.28], [0.22, 0.46, 0.33], [0.9, 0.86, 0.76], [0.45, 0.26, 0.48]]
)


def star_prism(points: np.ndarray) -> np.ndarray:
    """Distance to the glass: a star in the x-z plane, extruded along y, with rounded edges."""
    flat = distance.star(points, OUTER - ROUNDING, INNER - ROUNDING, tips=5)
    deep = np.abs(points[..., 1]) - (HALF_DEPTH - ROUNDING)
    # Rounds the concave notches and the crease between side and front alike.
    return distance.rounded(np.stack([flat, deep], -1), ROUNDING)


def planet_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: bands of cloud along the planet's latitudes, with a red spot."""
    latitude = points @ AXIS / PLANET_RADIUS
    swirl = fractal_noise(points * 14.0, 4, seed=2)
    band = 7.0 * latitude + 1.6 * swirl
    stripe = np.floor(band).astype(int)
    palette = np.array([[0.93, 0.8, 0.58], [0.8, 0.46, 0.26], [0.97, 0.92, 0.8], [0.62, 0.36, 0.3], [0.88, 0.64, 0.36]])
    colours = palette[stripe % len(palette)] * (0.85 + 0.3 * (swirl - 0.5))[:, None]
    spot = np.linalg.norm(points / PLANET_RADIUS - np.array([0.5, -0.78, 0.3]), axis=1)
    colours = mix(colours, np.array([0.80, 0.16, 0.12]), smoothstep(0.34, 0.30, spot))
    return mix(colours, np.array([0.98, 0.96, 0.90]), (np.abs(spot - 0.36) < 0.03).astype(float))


def ring_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: narrow concentric grooves in three tones of blue and sand."""
    radius = np.linalg.norm(points - (points @ AXIS)[:, None] * AXIS, axis=1)
    groove = np.floor((radius - RING_RADII[0]) / 0.0125).astype(int)
    palette = np.array([[0.30, 0.55, 0.78], [0.93, 0.88, 0.74], [0.14, 0.28, 0.48], [0.72, 0.80, 0.84]])
    return chosen(palette, hashed(groove[:, None], seed=4))


def ring(points: np.ndarray) -> np.ndarray:
    """Bound on the distance to the flat ring around the planet."""
    height = points @ AXIS
    radius = np.linalg.norm(points - height[..., None] * AXIS, axis=-1)
    across = np.abs(radius - sum(RING_RADII) / 2) - (RING_RADII[1] - RING_RADII[0]) / 2
    return np.maximum(across, np.abs(height) - 0.012) - 0.004


def sky(directions: np.ndarray) -> np.ndarray:
    """Return linear radiance [..., 3] of a room seen from its middle."""
    with np.errstate(divide="ignore"):
        reach = np.where(directions > 0, ROOM_HIGH / directions, ROOM_LOW / directions)
    reach = np.where(directions == 0, np.inf, reach)
    return to_linear(room(directions * reach.min(-1)[..., None], reach.argmin(-1)))


def room(points: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """Return sRGB [..., 3] of points [..., 3] on the room's sides; `wall` [...] is the axis that each side faces."""
    x, y, z = np.moveaxis(points, -1, 0)
    colour = np.where((x > 0)[..., None], _bookcase(y, z), _panelling(y, z))
    colour = np.where((wall == 1)[..., None], _windows(x, z, y > 0), colour)
    return np.clip(np.where((wall == 2)[..., None], _floor_and_ceiling(x, y, z > 0), colour), 0, 0.98)


def _bookcase(y: np.ndarray, z: np.ndarray) -> np.ndarray:
    shelf = np.floor((z + 1.0) / 0.36).astype(int)
    height = (z + 1.0) / 0.36 - shelf
    number = np.floor((y + 1.4) / 0.075).astype(int)
    across = (y + 1.4) / 0.075 - number
    key = np.stack([shelf, number], -1)
    top = 0.55 + 0.3 * hashed(key, 1)
    book = chosen(BOOKS, hashed(key, 2)) * (0.75 + 0.25 * hashed(key, 3))[..., None]
    label = (np.abs(height - 0.4) < 0.07) & (np.abs(across - 0.5) < 0.3)
    book = np.where(label[..., None], np.array([0.95, 0.90, 0.72]), book)
    book = np.where((across < 0.08)[..., None], 0.4 * book, book)
    colour = np.where((height < top)[..., None], book, np.array([0.24, 0.17, 0.12]))
    return np.where((height > 0.9)[..., None], np.array([0.58, 0.40, 0.24]), colour)


def _panelling(y: np.ndarray, z: np.ndarray) -> np.ndarray:
    u, v = (y + 1.4) / 0.28, (z + 1.0) / 0.28
    inside = np.hypot(u % 1 - 0.5, v % 1 - 0.5)
    paper = np.where((inside < 0.3)[..., None], np.array([0.86, 0.62, 0.42]), np.array([0.32, 0.48, 0.50]))
    paper = np.where((inside < 0.15)[..., None], np.array([0.95, 0.88, 0.74]), paper)
    lattice = (np.abs(u % 1 - v % 1) < 0.06) | (np.abs(u % 1 + v % 1 - 1) < 0.06)
    return np.where((lattice & (inside >= 0.3))[..., None], np.array([0.78, 0.80, 0.72]), paper)


def _windows(x: np.ndarray, z: np.ndarray, north: np.ndarray) -> np.ndarray:
    wall = np.where(north[..., None], np.array([0.90, 0.84, 0.72]), np.array([0.70, 0.50, 0.42]))
    wall = wall * (1 - 0.12 * ((np.floor(x / 0.1).astype(int) % 2) == 0))[..., None]
    motif = np.abs((x / 0.05) % 2 - 1.5) + np.abs((z / 0.05) % 2 - 1.0)
    wall = np.where(((motif < 0.42) & (motif > 0.2))[..., None], np.array([0.36, 0.46, 0.52]), wall)
    u, v = (x + 1.7) / 1.7, (z + 0.35) / 1.15
    across, frame_u = u % 1, np.abs((u % 1) - 0.5)
    pane = (frame_u < 0.36) & (v > 0) & (v < 1)
    view = mix(np.array([0.98, 0.97, 0.93]), np.array([0.66, 0.82, 0.96]), np.clip(v, 0, 1))
    hills = 0.22 + 0.1 * np.sin(9 * across + 2 * np.floor(u)) + 0.05 * np.sin(31 * across)
    view = np.where((v < hills)[..., None], np.array([0.42, 0.62, 0.36]), view)
    bar = (np.abs(frame_u) < 0.012) | (np.abs(v - 0.55) < 0.015) | (frame_u > 0.335) | (np.abs(v - 0.5) > 0.47)
    view = np.where(bar[..., None], np.array([0.96, 0.95, 0.92]), view)
    return np.where(pane[..., None], view, wall)


def _floor_and_ceiling(x: np.ndarray, y: np.ndarray, up: np.ndarray) -> np.ndarray:
    row = np.floor((y + 1.4) / 0.14).astype(int)
    shift = hashed(row[..., None], 7)
    plank = np.floor((x + shift) / 0.6).astype(int)
    tone = 0.65 + 0.35 * hashed(np.stack([row, plank], -1), 8)
    grain = fractal_noise(np.stack([x * 6 + 40 * shift, y * 60, 0 * x], -1), 3, 9)
    floor = np.array([0.76, 0.52, 0.32]) * (tone * (0.8 + 0.35 * grain))[..., None]
    gap = (((y + 1.4) / 0.14) % 1 < 0.05) | (((x + shift) / 0.6) % 1 < 0.012)
    floor = np.where(gap[..., None], 0.35 * floor, floor)
    rug = np.hypot(x / 1.1, y / 0.8)
    circle = np.floor(rug * 9).astype(int)
    sector = np.floor(np.arctan2(y / 0.8, x / 1.1) / (2 * np.pi) * 6 * (circle + 1)).astype(int)
    pattern = chosen(BOOKS, hashed(np.stack([circle, sector % (6 * (circle + 1))], -1), 5))
    floor = np.where((rug < 1)[..., None], pattern, floor)
    lamp = (np.abs(np.abs(x) - 0.8) < 0.55) & (np.abs(y) < 0.9)
    louvre = (y / 0.18) % 1 < 0.08
    ceiling = np.where((lamp & ~louvre)[..., None], np.array([0.98, 0.97, 0.94]), np.array([0.62, 0.60, 0.58]))
    return np.where(up[..., None], ceiling, floor)


def build(spacing: float) -> SyntheticScene:
    """Return the scene; `spacing` is the distance between neighbouring coloured vertices, world units."""
    spacing = max(spacing, 0.003)
    extent = np.full(3, 1.1 * PLANET_RADIUS)
    ball = functools.partial(distance.ball, centre=(0, 0, 0), radius=PLANET_RADIUS)
    planet = distance.painted(ball, planet_colours, -extent, extent, spacing)
    extent = np.full(3, 1.1 * RING_RADII[1])
    rings = distance.painted(ring, ring_colours, -extent, extent, min(spacing, 0.006))
    glass = distance.triangulate(star_prism, (-OUTER, -HALF_DEPTH, -OUTER), (OUTER, HALF_DEPTH, OUTER), 0.010)
    return SyntheticScene(ior=1.5, glass=glass, interior=join([planet, rings]), sky=sky)
