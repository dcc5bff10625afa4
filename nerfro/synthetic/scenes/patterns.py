"""Procedural colour: noise, steps and palettes as functions of position, and surroundings as functions of direction.

Positions and directions have any leading shape. Directions are unit vectors in a z-up world. Surroundings are layers of
sRGB colours, which a person judges by eye.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Return the cubic ramp that is 0 below `low` and 1 above `high`."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def mix(first: ArrayLike, second: ArrayLike, weight: ArrayLike) -> np.ndarray:
    """Blend colours [..., 3]: `first` where weight [...] is 0, `second` where it is 1."""
    weight = np.asarray(weight, np.float64)[..., None]
    return np.asarray(first) * (1 - weight) + np.asarray(second) * weight


def hashed(cells: np.ndarray, seed: int) -> np.ndarray:
    """Return a reproducible pseudo-random number in [0, 1) for every integer cell [..., D]; `seed` picks a field."""
    mixed = np.full(cells.shape[:-1], (seed * 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF, np.uint64)
    for axis in range(cells.shape[-1]):
        mixed = (mixed ^ cells[..., axis].astype(np.int64).astype(np.uint64)) * np.uint64(0xFF51AFD7ED558CCD)
        mixed ^= mixed >> np.uint64(33)
    mixed *= np.uint64(0xC4CEB9FE1A85EC53)
    mixed ^= mixed >> np.uint64(29)
    return (mixed >> np.uint64(11)).astype(np.float64) / float(1 << 53)


def value_noise(points: np.ndarray, seed: int) -> np.ndarray:
    """Return smooth noise in [0, 1): random values at the integer lattice, interpolated with smoothstep weights."""
    base = np.floor(points).astype(np.int64)
    fraction = points - base
    weights = fraction * fraction * (3 - 2 * fraction)
    total = np.zeros(points.shape[:-1])
    for offset in np.asarray(list(np.ndindex(*(2,) * points.shape[-1]))):
        share = np.where(offset == 1, weights, 1 - weights).prod(-1)
        total += share * hashed(base + offset, seed)
    return total


def fractal_noise(points: np.ndarray, octaves: int, seed: int) -> np.ndarray:
    """Return the sum of `octaves` of value noise, each twice as fine and half as strong, scaled to [0, 1)."""
    total, norm = np.zeros(points.shape[:-1]), 0.0
    for octave in range(octaves):
        total += 0.5**octave * value_noise(points * 2.0**octave, seed + octave)
        norm += 0.5**octave
    return total / norm


def chosen(palette: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the palette entry [..., 3] that a number in [0, 1) picks from `palette` [K, 3]."""
    palette = np.asarray(palette)
    return palette[np.minimum((number * len(palette)).astype(int), len(palette) - 1)]


def azimuth(directions: np.ndarray) -> np.ndarray:
    """Return the angle around z from +x towards +y, in turns [0, 1)."""
    return (np.arctan2(directions[..., 1], directions[..., 0]) / (2 * np.pi)) % 1.0


def elevation(directions: np.ndarray) -> np.ndarray:
    """Return the angle above the horizon in degrees, [-90, 90]."""
    return np.degrees(np.arcsin(np.clip(directions[..., 2], -1.0, 1.0)))


def clouds(directions: np.ndarray, horizon: tuple, zenith: tuple, cover: float, seed: int) -> np.ndarray:
    """Paint sRGB [..., 3]: a gradient of sRGB colours from `horizon` to `zenith` with clouds on a flat layer.

    `cover` in [0, 1] is about the share of clouds; `seed` selects them.
    """
    height = np.maximum(directions[..., 2], 0.0)
    colour = mix(np.asarray(horizon), np.asarray(zenith), height**0.6)
    layer = directions[..., :2] / (height + 0.25)[..., None]
    density = fractal_noise(np.concatenate([3 * layer, np.zeros_like(layer[..., :1])], -1), 5, seed)
    amount = smoothstep(0.62 - 0.3 * cover, 0.72 - 0.3 * cover, density) * smoothstep(0.02, 0.2, height)
    shade = mix(np.array([0.80, 0.83, 0.88]), np.array([0.98, 0.98, 0.97]), smoothstep(0.45, 0.75, density))
    return mix(colour, shade, amount)


def skyline(
    directions: np.ndarray, palette: np.ndarray, count: int, heights: tuple[float, float], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Paint a row of `count` houses with windows on the horizon, their roofs between two `heights`, degrees.

    Returns sRGB [..., 3], of facades from a `palette` [K, 3], and coverage [...], 1 where there is a house.
    """
    turn, height = azimuth(directions) * count, elevation(directions)
    house = np.floor(turn).astype(np.int64)
    across = turn - house
    key = house[..., None]
    roof = heights[0] + (heights[1] - heights[0]) * hashed(key, seed)
    # About a third of the houses have a gable, so that some roof lines are not horizontal.
    gable = np.where(hashed(key, seed + 1) < 0.4, 5.0 * (1 - 2 * np.abs(across - 0.5)), 0.0)
    facade = chosen(palette, hashed(key, seed + 2))
    columns = 3 + np.floor(3 * hashed(key, seed + 3))
    column, row = np.floor(across * columns), np.floor(height / 3.2)
    u, v = across * columns - column, height / 3.2 - row
    window = (np.abs(u - 0.5) < 0.27) & (np.abs(v - 0.5) < 0.3) & (height < roof - 1.0) & (height > 0.5)
    pane = np.stack([house, column.astype(np.int64), row.astype(np.int64)], -1)
    glow = np.array([[0.12, 0.15, 0.22], [0.20, 0.27, 0.36], [0.98, 0.86, 0.55], [0.62, 0.76, 0.86]])
    colour = np.where(window[..., None], chosen(glow, hashed(pane, seed + 4)), facade)
    edge = np.abs(across - 0.5) > 0.47
    colour = np.where(edge[..., None], colour * 0.55, colour)
    covered = (height < roof + gable) & (height >= 0)
    above_roof = height > roof
    return np.where(above_roof[..., None], np.array([0.55, 0.24, 0.18]), colour), covered.astype(np.float64)
