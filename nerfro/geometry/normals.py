"""Normals of triangle meshes: smooth where the surface is smooth, split at creases."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nerfro.geometry.mesh import TriangleMesh

# Ratio of the largest to the smallest triangle around a vertex from which on the large one decides.
_UNEVEN = 8.0


def face_normals(mesh: TriangleMesh) -> Float[np.ndarray, "F 3"]:
    """Unit normals by the right-hand rule; zero for triangles without area."""
    a, b, c = mesh.triangles.swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


def corner_normals(mesh: TriangleMesh, crease_degrees: float = 30.0) -> Float[np.ndarray, "F 3 3"]:
    """Unit normal at each corner of each triangle, smooth over the vertex up to creases.

    The mesh's own normals are taken where it has them and they lie within the crease angle of the face. Else it is the
    mean normal of the faces around the vertex whose normals are within the crease angle of the corner's own face, with
    the weights |e1 x e2| / (|e1|^2 |e2|^2), e the edges at the vertex, which are exact for spheres. Where a large face
    meets much smaller ones, as a flat side meets its rounded edge, the weights are the areas instead: there the large
    face knows the normal.

    Args:
        mesh: triangles.
        crease_degrees: larger angles between faces are edges of the object.

    Source:
        N. Max, "Weights for computing vertex normals from facet normals", Journal of Graphics Tools 4(2), 1999.
    """
    normals = face_normals(mesh)
    triangles = mesh.triangles
    forward = np.roll(triangles, -1, axis=1) - triangles
    backward = np.roll(triangles, 1, axis=1) - triangles
    lengths = (forward**2).sum(-1) * (backward**2).sum(-1)
    areas = np.linalg.norm(np.cross(forward, backward), axis=-1)
    weights = np.divide(areas, lengths, out=np.zeros_like(areas), where=lengths > 0)
    # All pairs of corners that meet in a vertex: corners sorted by vertex, then every corner against its whole run.
    corner_vertex = mesh.faces.reshape(-1)
    order = np.argsort(corner_vertex, kind="stable")
    starts = np.searchsorted(corner_vertex[order], np.arange(len(mesh.vertices) + 1))
    runs = np.diff(starts)[corner_vertex]
    first = np.repeat(np.arange(len(corner_vertex)), runs)
    within = np.arange(runs.sum()) - np.repeat(np.cumsum(runs) - runs, runs)
    second = order[np.repeat(starts[corner_vertex], runs) + within]
    smooth = (normals[first // 3] * normals[second // 3]).sum(1) >= np.cos(np.radians(crease_degrees))
    area = areas.reshape(-1)
    fan_areas = np.where(smooth, area[second], area[first])
    fans = np.cumsum(runs) - runs
    uneven = np.maximum.reduceat(fan_areas, fans) > _UNEVEN * np.minimum.reduceat(fan_areas, fans)
    weight = np.where(uneven[first], area[second], weights.reshape(-1)[second]) * smooth
    contribution = normals[second // 3] * weight[:, None]
    sums = np.stack([np.bincount(first, contribution[:, axis], len(corner_vertex)) for axis in range(3)], -1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    own = np.repeat(normals, 3, axis=0)
    smoothed = np.where(length > 0, sums / np.where(length > 0, length, 1), own).reshape(-1, 3, 3)
    if mesh.normals is None:
        return smoothed
    # Averages tilt where large flat triangles meet small round ones; a modeller's normals do not.
    trusted = (mesh.normals * normals[:, None]).sum(-1, keepdims=True) >= np.cos(np.radians(crease_degrees))
    return np.where(trusted, mesh.normals, smoothed)
