"""Procedural colour: noise, steps and palettes, as pure functions of position (numpy, any leading shape)."""

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
