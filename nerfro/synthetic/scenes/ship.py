"""`ship`: a sailing ship inside a green-tinted glass box, on the sea near a harbour."""

from __future__ import annotations

import functools

import numpy as np

from nerfro.core.light import to_linear
from nerfro.synthetic.scene import SyntheticScene, join, rounded_box
from nerfro.synthetic.scenes.distance import ball, block, capsule, painted
from nerfro.synthetic.scenes.patterns import (
    azimuth,
    chosen,
    clouds,
    elevation,
    fractal_noise,
    hashed,
    mix,
    skyline,
    smoothstep,
)

HALF_SIDES, EDGE_RADIUS = (0.80, 0.50, 0.66), 0.07
TINT = (0.86, 0.98, 0.90)
KEEL, DECK, HALF_LENGTH, HALF_BEAM = -0.40, -0.16, 0.54, 0.17
MASTS = ((-0.20, 0.36), (0.16, 0.44))  # x of the mast and height of its top
# x, lowest and highest z, half width of each sail
SAILS = ((-0.20, -0.06, 0.10, 0.24), (-0.20, 0.13, 0.29, 0.19), (0.16, -0.06, 0.13, 0.27), (0.16, 0.16, 0.36, 0.21))
CABIN = functools.partial(block, centre=(-0.38, 0, -0.07), half_sides=(0.09, 0.085, 0.09), rounding=0.015)
HOUSES = np.array([[0.93, 0.89, 0.80], [0.78, 0.42, 0.36], [0.52, 0.62, 0.70], [0.88, 0.74, 0.50]])


def hull(points: np.ndarray) -> np.ndarray:
    """Bound on the distance to the hull: a beam that tapers towards bow, stern and keel, cut flat at the deck."""
    x, y, z = np.moveaxis(points, -1, 0)
    sheer = DECK + 0.10 * (np.clip(x, -HALF_LENGTH, HALF_LENGTH) / HALF_LENGTH) ** 2
    depth = np.clip((z - KEEL) / (sheer - KEEL), 0.0, 1.0)
    length = HALF_LENGTH * (0.72 + 0.28 * depth)
    beam = HALF_BEAM * np.sqrt(depth) * np.maximum(1 - (x / length) ** 2, 0.0) ** 0.75
    side = np.abs(y) - beam
    # The beam is steep where the planks bend in: half the value is a safe bound on the distance.
    return 0.5 * np.maximum(np.maximum(side, z - sheer), np.maximum(KEEL + 0.01 - z, np.abs(x) - length))


def hull_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: planks with nails above a red bottom, gun ports, a planked deck."""
    x, y, z = points.T
    sheer = DECK + 0.10 * (x / HALF_LENGTH) ** 2
    row = np.floor((z - sheer) / 0.022).astype(int)
    plank = np.floor(x / 0.13 + 0.37 * row).astype(int)
    tone = 0.70 + 0.30 * hashed(np.stack([row, plank], -1), 1)
    wood = np.array([0.76, 0.48, 0.26]) * tone[:, None]
    wood = np.where((row < -7)[:, None], np.array([0.74, 0.16, 0.14]) * tone[:, None], wood)
    wood = np.where((row == -7)[:, None], np.array([0.95, 0.94, 0.90]), wood)
    seam = (((z - sheer) / 0.022) % 1 < 0.13) | ((x / 0.13 + 0.37 * row) % 1 < 0.05)
    wood = np.where(seam[:, None], 0.4 * wood, wood)
    port = (np.abs((x / 0.10) % 1 - 0.5) < 0.17) & (np.abs(z - sheer + 0.065) < 0.018) & (np.abs(x) < 0.38)
    wood = np.where(port[:, None], np.array([0.08, 0.08, 0.10]), wood)
    board = np.floor(y / 0.025).astype(int)
    deck = np.array([0.90, 0.74, 0.50]) * (0.75 + 0.25 * hashed(board[:, None], 2))[:, None]
    deck = np.where(((y / 0.025) % 1 < 0.15)[:, None], 0.5 * deck, deck)
    return np.where((z > sheer - 0.006)[:, None], deck, wood)


def sail(points: np.ndarray, x: float, low: float, high: float, half_width: float) -> np.ndarray:
    """Bound on the distance to a sail that the wind from -x has filled."""
    u = np.clip(points[..., 1] / half_width, -1, 1)
    v = np.clip((2 * points[..., 2] - low - high) / (high - low), -1, 1)
    belly = x + 0.02 + 0.07 * (1 - u**2) * (1 - v**2)
    sheet = np.abs(points[..., 0] - belly) - 0.007
    tall = np.abs(points[..., 2] - (low + high) / 2) - (high - low) / 2
    return 0.5 * np.maximum(sheet, np.maximum(np.abs(points[..., 1]) - half_width, tall))


def sail_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: red and cream stripes with seams, and an emblem on the lower sails."""
    _, y, z = points.T
    stripe = np.floor(y / 0.06 + 0.5).astype(int)
    colours = np.where((stripe % 2 == 0)[:, None], np.array([0.96, 0.92, 0.82]), np.array([0.82, 0.24, 0.20]))
    weave = 0.86 + 0.14 * fractal_noise(points * 45.0, 3, seed=3)
    colours = colours * weave[:, None]
    colours = np.where(((z / 0.045) % 1 < 0.09)[:, None], 0.75 * colours, colours)
    radius = np.hypot(y, z - 0.03)
    colours = np.where((radius < 0.075)[:, None], np.array([0.97, 0.80, 0.25]), colours)
    rays = np.sin(8 * np.arctan2(z - 0.03, y)) > 0
    blue = ((radius < 0.062) & rays & (radius > 0.03)) | (radius < 0.02)
    return np.where(blue[:, None], np.array([0.13, 0.26, 0.50]), colours)


def rigging(points: np.ndarray) -> np.ndarray:
    """Bound on the distance to masts, yards, bowsprit and crow's nests."""
    rods = [capsule(points, (0.44, 0, -0.09), (0.72, 0, 0.05), 0.018, 0.010)]
    for x, top in MASTS:
        rods.append(capsule(points, (x, 0, DECK - 0.02), (x, 0, top + 0.06), 0.020, 0.010))
        rods.append(ball(points, (x, 0, top + 0.02), 0.035))
    for x, _, high, half_width in SAILS:
        x, end = x + 0.01, half_width + 0.03
        rods.append(capsule(points, (x, -end, high), (x, end, high), 0.012, 0.012))
    return np.minimum.reduce(rods)


def rigging_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: dark wood with light rings."""
    ring = ((points[:, 2] * 14 + points[:, 1] * 14 + points[:, 0] * 3) % 1 < 0.3)[:, None]
    return np.where(ring, np.array([0.88, 0.76, 0.52]), np.array([0.42, 0.26, 0.16]))


def cabin_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3] of the cabin at the stern: blue walls, lit windows, a shingled roof."""
    x, y, z = points.T
    walls = np.tile(np.array([0.22, 0.44, 0.60]), (len(x), 1))
    window = (np.abs(((x + y) / 0.055) % 1 - 0.5) < 0.25) & (np.abs(z + 0.05) < 0.022)
    walls = np.where(window[:, None], np.array([0.99, 0.86, 0.45]), walls)
    shingle = hashed(np.stack([np.floor(x / 0.02), np.floor(y / 0.03)], -1).astype(int), 6)
    roof = np.array([0.62, 0.28, 0.22]) * (0.6 + 0.5 * shingle)[:, None]
    return np.where((z > 0.005)[:, None], roof, walls)


def sky(directions: np.ndarray) -> np.ndarray:
    """Return linear radiance [..., 3] of a bay at sunset: clouds, a town, a lighthouse, islands and waves."""
    colour = clouds(directions, horizon=(0.99, 0.80, 0.60), zenith=(0.38, 0.52, 0.82), cover=0.70, seed=23)
    height, turn = elevation(directions), azimuth(directions)
    side = np.sin(4 * np.pi * turn)
    ridge = 3 + 9 * fractal_noise(np.stack([turn * 30, 0 * turn, 0 * turn], -1), 4, seed=31) * (side > 0)
    rock = 0.6 + 0.6 * fractal_noise(np.stack([turn * 160, height / 1.5, 0 * turn], -1), 3, seed=32)
    island = np.array([0.36, 0.46, 0.36]) * rock[..., None]
    colour = mix(colour, island, (height < ridge) & (side > 0.05))
    houses, covered = skyline(directions, HOUSES, count=40, heights=(5.0, 13.0), seed=17)
    colour = mix(colour, houses, covered * (side < -0.15))
    across = (turn - 0.17) * 360
    tower = (np.abs(across) < 2.6 - 0.05 * height) & (height < 26)
    red = (np.floor(height / 4.0) % 2 == 0)[..., None]
    bands = np.where(red, np.array([0.80, 0.18, 0.16]), np.array([0.97, 0.95, 0.90]))
    colour = mix(colour, bands, tower)
    colour = mix(colour, np.array([1.0, 0.93, 0.62]), (np.abs(across) < 2.0) & (height > 22) & (height < 25))
    colour = mix(colour, _sea(directions), height < 0)
    return to_linear(np.clip(colour, 0.0, 0.98))


def _sea(directions: np.ndarray) -> np.ndarray:
    depth = np.maximum(-directions[..., 2], 1e-3)
    surface = directions[..., :2] / np.maximum(depth, 0.04)[..., None]
    swirl = fractal_noise(np.concatenate([2.2 * surface, 0 * surface[..., :1]], -1), 4, seed=41)
    wave = 0.5 + 0.5 * np.sin(9 * surface[..., 0] + 4 * surface[..., 1] + 9 * swirl)
    water = mix(np.array([0.06, 0.32, 0.44]), np.array([0.22, 0.60, 0.66]), wave)
    foam = smoothstep(0.80, 0.88, wave) * (swirl > 0.48)
    water = mix(water, np.array([0.93, 0.97, 0.96]), foam)
    cell = np.floor(surface / 0.5).astype(int)
    offset = surface / 0.5 - cell - 0.5
    buoy = np.linalg.norm(offset - 0.3 * (hashed(cell, 42) - 0.5)[..., None], axis=-1)
    hue = chosen(HOUSES * [1, 0.7, 0.5], hashed(cell, 43))
    painted_buoy = np.where((buoy < 0.05)[..., None], np.array([0.98, 0.95, 0.88]), hue)
    water = np.where(((buoy < 0.11) & (hashed(cell, 44) < 0.35))[..., None], painted_buoy, water)
    return mix(np.array([0.80, 0.72, 0.64]), water, smoothstep(0.0, 0.12, depth))


def build(spacing: float) -> SyntheticScene:
    """Return the scene; `spacing` is the distance between neighbouring coloured vertices, world units."""
    spacing = max(spacing, 0.0035)
    fine = min(spacing, 0.006)  # thin parts need a fine mesh whatever the resolution of the images
    parts = [
        painted(hull, hull_colours, (-0.55, -0.18, -0.41), (0.55, 0.18, -0.05), fine),
        painted(rigging, rigging_colours, (-0.24, -0.31, -0.19), (0.74, 0.31, 0.52), fine),
        painted(CABIN, cabin_colours, (-0.48, -0.10, -0.17), (-0.28, 0.10, 0.03), fine),
    ]
    for x, low, high, half_width in SAILS:
        sheet = functools.partial(sail, x=x, low=low, high=high, half_width=half_width)
        corners = (x, -half_width, low), (x + 0.1, half_width, high)
        parts.append(painted(sheet, sail_colours, *corners, min(fine, 0.005)))
    glass = rounded_box(HALF_SIDES, EDGE_RADIUS, edge_steps=12)
    return SyntheticScene(ior=1.5, glass=glass, interior=join(parts), sky=sky, tint=TINT)
