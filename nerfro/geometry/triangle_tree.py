"""A tree of bounding boxes over the triangles of bodies, as kernels take it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nerfro.geometry.intersection import Triangles

LEAF = 4  # number of triangles of a leaf
_MARGIN = 1e-9  # of boxes, so that rounding errors miss no triangle, as a fraction of the extent


class TriangleTree(NamedTuple):
    """Binary tree of bounding boxes, in which node i has the children 2 i + 1 and 2 i + 2.

    All leaves have the same depth; to fill them, some triangles occur twice.
    """

    boxes: Float[np.ndarray, "nodes 2 3"]  # lowest and highest corner of each node, world units
    leaves: Int[np.ndarray, "leaves 4"]  # triangles of the last nodes
    # Corners, normals and body of each triangle, see `Triangles`, and its layer, see `intersection.layers`.
    corners: Float[np.ndarray, "F 3 3"]
    normals: Float[np.ndarray, "F 3 3"]
    body: Int[np.ndarray, "F"]
    layer: Int[np.ndarray, "F"]
    num_layers: int
    offset: float  # distance from a surface at which the search for the next one begins, world units

    @classmethod
    def of(cls, triangles: Triangles, layer: Int[np.ndarray, "F"], offset: float) -> TriangleTree:
        """Build the tree by splitting the triangles of each node in halves along the longest side of their centres."""
        corners = triangles.corners.numpy()
        number, centres = len(corners), corners.mean(1)
        num_leaves = 1 << max(0, math.ceil(math.log2(number / LEAF)))
        order = (np.arange(LEAF * num_leaves) * number // (LEAF * num_leaves))[None]
        while len(order) < num_leaves:
            points = centres[order]
            axis = np.ptp(points, axis=1).argmax(-1)
            along = np.take_along_axis(points, axis[:, None, None], 2)[..., 0]
            halves = np.argpartition(along, order.shape[1] // 2, axis=1)
            order = np.take_along_axis(order, halves, 1).reshape(2 * len(order), -1)
        levels = [np.stack([corners[order].min((1, 2)), corners[order].max((1, 2))], 1)]
        while len(levels[0]) > 1:
            low, high = levels[0][:, 0].reshape(-1, 2, 3).min(1), levels[0][:, 1].reshape(-1, 2, 3).max(1)
            levels.insert(0, np.stack([low, high], 1))
        boxes = np.concatenate(levels) + _MARGIN * np.ptp(levels[0][0], axis=0).max() * np.array([[-1.0], [1.0]])
        normals, body = triangles.normals.numpy(), triangles.body.numpy()
        return cls(boxes, order, corners, normals, body, layer, int(layer.max()) + 1, offset)
