"""Procedural surroundings at infinity: layers painted as functions of direction.

Directions are unit vectors in a z-up world. Layers return sRGB colours, which a person judges by eye.
"""

from __future__ import annotations

import numpy as np

from nerfro.synthetic.scenes.patterns import chosen, fractal_noise, hashed, mix, smoothstep


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
