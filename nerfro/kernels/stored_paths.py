"""Gathering stored paths of training rays on the CPU, one thread per ray; used by `samplers.path_cache` alone."""

from __future__ import annotations

from numba import prange

from nerfro.kernels.compilation import compiled_parallel


@compiled_parallel
def gather_paths(starts, vertices, rows, origins, directions, near, far, tolerance, paths):
    """Fill `paths` [R, V, 7] with position, direction and arc length of each ray's vertices.

    Rays without vertices of their own go straight from near to far; shorter paths repeat their last vertex.

    Returns:
        Number of rays whose stored path begins in another direction than theirs, by more than the tolerance.
    """
    num_other = 0
    width = paths.shape[1]
    for ray in prange(rows.shape[0]):
        first = starts[rows[ray]]
        count = starts[rows[ray] + 1] - first
        if count == 0:
            for vertex in range(width):
                s = near[ray] if vertex == 0 else far[ray]
                for axis in range(3):
                    paths[ray, vertex, axis] = origins[ray, axis] + s * directions[ray, axis]
                    paths[ray, vertex, 3 + axis] = directions[ray, axis]
                paths[ray, vertex, 6] = s
        else:
            for vertex in range(width):
                source = first + min(vertex, count - 1)
                for column in range(7):
                    paths[ray, vertex, column] = vertices[source, column]
            other = False
            for axis in range(3):
                other = other or abs(paths[ray, 0, 3 + axis] - directions[ray, axis]) > tolerance
            num_other += other
    return num_other
