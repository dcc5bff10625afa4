"""An independent tracer of rounded glass cubes in double precision, for one ray at a time, without code of nerfro."""

from __future__ import annotations

import math

import numpy as np

MAX_BOUNCES = 12


def _exit_distance(x: np.ndarray, d: np.ndarray, a: float, r: float) -> float:
    """Distance to the exit from a rounded cube that contains x, by its boxes, cylinders and balls one by one.

    It is convex, so a ray inside leaves it where it leaves the last of the convex pieces that make it up.
    """
    inner, last = a - r, 0.0

    def quadratic(p: np.ndarray, q: np.ndarray) -> tuple[float, float] | None:
        qq, pq, pp = q @ q, p @ q, p @ p - r * r
        root = pq * pq - qq * pp
        if qq < 1e-300 or root < 0:
            return None
        return (-pq - math.sqrt(root)) / qq, (-pq + math.sqrt(root)) / qq

    for wide in range(3):  # boxes that reach two opposite faces
        half = np.full(3, inner)
        half[wide] = a
        with np.errstate(divide="ignore"):
            planes = np.stack([(-half - x) / d, (half - x) / d])
        enter, leave = planes.min(0).max(), planes.max(0).min()
        if enter < leave:
            last = max(last, leave)
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for u in (-inner, inner):
            for v in (-inner, inner):
                span = quadratic(x[others] - (u, v), d[others])
                if span is None:
                    continue
                ends = sorted([(-inner - x[axis]) / d[axis], (inner - x[axis]) / d[axis]])
                enter, leave = max(span[0], ends[0]), min(span[1], ends[1])
                if enter < leave:
                    last = max(last, leave)
    for corner in np.stack(np.meshgrid(*[[-inner, inner]] * 3), -1).reshape(-1, 3):
        span = quadratic(x - corner, d)
        if span is not None:
            last = max(last, span[1])
    return last


def trace_rounded_cube(x: np.ndarray, d: np.ndarray, a: float, r: float, n: float) -> tuple[np.ndarray, int]:
    """Follow one ray through a rounded cube of glass around the origin.

    Args:
        x, d: origin and unit direction of the ray; it begins outside.
        a: half side of the cube.
        r: radius of its edges.
        n: refractive index.

    Returns:
        Exit direction and number of total reflections; the given direction and -1 for a ray that misses.
    """
    inner = a - r

    def normal(p: np.ndarray) -> np.ndarray:
        outward = p - p.clip(-inner, inner)
        return outward / np.linalg.norm(outward)

    middle = x + d * max(0.0, -(x @ d))
    if _signed_distance(middle, a, r) > 0:
        return d, -1
    # The entry of a ray is the exit of its reverse.
    entry = middle - d * _exit_distance(middle, -d, a, r)
    m = normal(entry)
    c = -m @ d
    d = d / n + (c / n - math.sqrt(1 - (1 - c * c) / n**2)) * m
    x, bounces = entry + 1e-12 * d, 0
    while True:
        x = x + d * _exit_distance(x, d, a, r)
        m = -normal(x)
        c = -m @ d
        squared = 1 - n * n * (1 - c * c)
        if squared >= 0:
            return n * d + (n * c - math.sqrt(squared)) * m, bounces
        d = d + 2 * c * m
        d /= np.linalg.norm(d)
        x, bounces = x + 1e-12 * d, bounces + 1
        if bounces > MAX_BOUNCES:
            return d, bounces


def _signed_distance(p: np.ndarray, a: float, r: float) -> float:
    q = np.abs(p) - (a - r)
    return float(np.linalg.norm(q.clip(0)) + min(q.max(), 0.0) - r)
