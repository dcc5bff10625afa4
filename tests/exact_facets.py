"""Exact refraction at flat triangles, in double precision and without acceleration."""

import numpy as np


def exit_directions(triangles: np.ndarray, ior: float, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Trace rays through a closed body of flat triangles; rays that do not leave within 40 events are NaN."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    exits = np.full(directions.shape, np.nan)
    for row, (x, d) in enumerate(zip(origins, directions, strict=True)):
        last = -1
        for _ in range(40):
            face, length = _first_hit(triangles, x, d, last)
            if face < 0:
                exits[row] = d
                break
            x, last = x + length * d, face
            d = _refracted(d, normals[face], ior)
    return exits


def _first_hit(triangles: np.ndarray, x: np.ndarray, d: np.ndarray, last: int) -> tuple[int, float]:
    """Return the first triangle along a ray and its distance (Moeller and Trumbore 1997), or -1."""
    one, two = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(d, two)
    determinant = (one * across).sum(1)
    determinant[determinant == 0] = np.inf
    offset = x - triangles[:, 0]
    u = (offset * across).sum(1) / determinant
    turned = np.cross(offset, one)
    v = turned @ d / determinant
    length = (turned * two).sum(1) / determinant
    met = (u >= 0) & (v >= 0) & (u + v <= 1) & (length > 1e-9) & np.isfinite(determinant)
    if last >= 0:
        met[last] = False
    length = np.where(met, length, np.inf)
    face = int(length.argmin())
    return (face, float(length[face])) if met[face] else (-1, 0.0)


def _refracted(d: np.ndarray, normal: np.ndarray, ior: float) -> np.ndarray:
    """Refract a direction at a face with the outward normal, or reflect it totally."""
    cosine = float(d @ normal)
    ratio = ior if cosine > 0 else 1 / ior
    squared = 1 - ratio**2 * (1 - cosine**2)
    if squared < 0:
        return d - 2 * cosine * normal
    return ratio * (d - cosine * normal) + np.sign(cosine) * np.sqrt(squared) * normal
