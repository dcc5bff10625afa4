"""A tree of bounding boxes over the triangles of bodies, as kernels take it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nerfro.geometry.intersection import Triangles

_MARGIN = 1e-9  # of boxes, so that rounding errors miss no triangle, as a fraction of the extent


class TriangleTree(NamedTuple):
    """Binary tree of bounding boxes, in which node i has the children 2 i + 1 and 2 i + 2.

    All leaves have the same depth and size; to fill them, some triangles occur twice.
    """

    boxes: Float[np.ndarray, "nodes 2 3"]  # lowest and highest corner of each node, world units
    leaves: Int[np.ndarray, "leaves size"]  # triangles of the last nodes
    leaf_corners: Float[np.ndarray, "leaves size 3 3"]  # their corners, in the order in which the search reads them
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
        corners, levels = triangles.corners.numpy(), []
        number = len(corners)
        # A leaf has at least three triangles, and less than twice as many.
        num_leaves = 1 << max(0, math.floor(math.log2(number / 3)))
        num_entries = -(-number // num_leaves) * num_leaves
        order = (np.arange(num_entries) * number // num_entries)[None]
        while True:
            points = corners[order]
            levels.append(np.stack([points.min((1, 2)), points.max((1, 2))], 1))
            if len(order) == num_leaves:
                break
            centres = points.mean(2)
            axis = np.ptp(centres, axis=1).argmax(-1)
            along = np.take_along_axis(centres, axis[:, None, None], 2)[..., 0]
            halves = np.argpartition(along, order.shape[1] // 2, axis=1)
            order = np.take_along_axis(order, halves, 1).reshape(2 * len(order), -1)
        boxes = np.concatenate(levels) + _MARGIN * np.ptp(levels[0]) * np.array([[-1.0], [1.0]])
        normals, body = triangles.normals.numpy(), triangles.body.numpy()
        return cls(boxes, order, points, corners, normals, body, layer, int(layer.max()) + 1, offset)
