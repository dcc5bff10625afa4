"""Reconstruction of sharp edges, which a fit with displacements along normals leaves rounded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float

from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.normals import unit
from nerfro.silhouettes.moving_mesh import MeshGeometry, MovingMesh, solve_symmetric
from nerfro.silhouettes.rims import Rims


@dataclass(frozen=True)
class Sides:
    """Weights of the prior on the sides between sharp edges, relative to one observation of the outline."""

    flat: float  # alignment of triangles with the filtered normals
    staying: float  # damping of the displacements


@dataclass(frozen=True)
class CreaseSettings(AlgorithmSettings):
    """Settings of sharp edges (`sharpened`), chosen on a box and a cylinder, confirmed on a hexagonal prism.

    Attributes:
        steps: number of least-squares steps.
        rounds: number of smoothing rounds of the triangle normals.
        angular_width: width of the filter of the normals, in radians.
        facets, curved: priors of the two variants of a surface, for flat and for curved sides.
    """

    steps: int = 12
    rounds: int = 3
    angular_width: float = 0.35
    facets: Sides = Sides(flat=1.0, staying=1e-5)
    curved: Sides = Sides(flat=0.05, staying=1e-4)


def has_creases(surface: MeshGeometry) -> bool:
    """Test whether the total length of the sharp edges exceeds twice the size of the body."""
    ends = surface.vertices[surface.creases]
    return bool(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum() > 2 * np.ptp(surface.vertices, axis=0).max())


def sharpened(
    vertices: Float[np.ndarray, "vertices 3"],
    mesh: MovingMesh,
    rims_of: Callable[[Float[np.ndarray, "vertices 3"]], Rims],
    sides: Sides,
    step: Callable[[], object] = lambda: None,
    settings: CreaseSettings = CreaseSettings(),
) -> Float[np.ndarray, "vertices 3"]:
    """Move vertices in all directions until sides are smooth, edges are sharp, and contours meet the masks.

    Marching cubes bevel an edge with a row of triangles. Each triangle first receives a filtered normal m_f, the normal
    of one adjacent side (see `_filtered_normals`). Then linear least squares minimize the misfits of the contours and

        sum_faces A_f sum_sides (m_f . (x_i - x_j))^2

    with the areas A_f, which moves the vertices between two sides to the intersection of the sides.

    Args:
        vertices: vertices of a fitted surface with rounded edges.
        mesh: triangles of the surface.
        rims_of: function that returns the contour points of a surface with given vertices.
        sides: weights of the prior.
        step: called after each step.
        settings: number of steps, and the filter of the normals.

    Returns:
        The new vertices.
    """
    settings.use()
    for _ in range(settings.steps):
        vertices = _solved(vertices, mesh, rims_of(vertices), sides, settings)
        step()
    return vertices


def _solved(
    vertices: Float[np.ndarray, "vertices 3"], mesh: MovingMesh, rims: Rims, sides: Sides, settings: CreaseSettings
) -> Float[np.ndarray, "vertices 3"]:
    direction, area = _filtered_normals(vertices, mesh, settings)
    weight = np.sqrt(np.repeat(area / area.mean(), 3))
    flat = _projected_differences(
        (mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()),
        (weight, -weight),
        np.repeat(direction, 3, axis=0),
        len(vertices),
    )
    observed = _projected_differences(
        (rims.first, rims.second), (1 - rims.fraction, rims.fraction), rims.normal, len(vertices)
    )
    flatness, staying = len(rims.fraction) * sides.flat, len(rims.fraction) * sides.staying
    system = observed.T @ scipy.sparse.diags(rims.weight) @ observed + flatness * (flat.T @ flat)
    system += staying * scipy.sparse.identity(3 * len(vertices))
    right = observed.T @ (rims.weight * rims.misfit) - flatness * (flat.T @ (flat @ vertices.ravel()))
    right += staying * (mesh.spread(vertices) - vertices).ravel()
    step = solve_symmetric(system, right).reshape(-1, 3)
    longest = mesh.edge_length(vertices)
    return vertices + step * np.minimum(1, longest / np.linalg.norm(step, axis=1, keepdims=True).clip(1e-12))


def _filtered_normals(
    vertices: Float[np.ndarray, "vertices 3"], mesh: MovingMesh, settings: CreaseSettings
) -> tuple[Float[np.ndarray, "F 3"], Float[np.ndarray, "F"]]:
    """Filter the triangle normals without smoothing across sharp edges (guided normal filtering, Zhang et al. 2015).

    The guide normal of a triangle is the mean normal of the most uniform patch of triangles around it.

    Returns:
        Filtered unit normals, and the areas of the triangles.
    """
    normals = mesh.face_normals(vertices)
    area, touching = np.linalg.norm(normals, axis=1), mesh.touching
    row, column = touching.row, touching.col
    patch = touching @ normals
    uneven = 1 - np.linalg.norm(patch, axis=1) / (touching @ area)
    order = np.lexsort((uneven[column], row))
    guide = unit(patch)[column[order[np.diff(row[order], prepend=-1) != 0]]]

    middle = vertices[mesh.faces].mean(1)
    squared_distance = ((middle[row] - middle[column]) ** 2).sum(1)
    squared_difference = ((guide[row] - guide[column]) ** 2).sum(1)
    variance = squared_distance[squared_distance > 0].mean()
    weights = np.exp(-squared_distance / (2 * variance) - squared_difference / (2 * settings.angular_width**2))
    weights = area[column] * weights
    averaging, direction = scipy.sparse.csr_matrix((weights, (row, column)), touching.shape), unit(normals)
    for _ in range(settings.rounds):
        direction = unit(averaging @ direction)
    return direction, area


def _projected_differences(
    ends: tuple[np.ndarray, np.ndarray],
    weights: tuple[np.ndarray, np.ndarray],
    directions: Float[np.ndarray, "rows 3"],
    num_vertices: int,
) -> scipy.sparse.csr_matrix:
    """Build the matrix that maps vertex coordinates to weighted sums of two vertices along directions, one per row."""
    row = np.tile(np.repeat(np.arange(len(directions)), 3), 2)
    column = np.concatenate([(3 * end[:, None] + np.arange(3)).ravel() for end in ends])
    values = np.concatenate([(weight[:, None] * directions).ravel() for weight in weights])
    return scipy.sparse.csr_matrix((values, (row, column)), (len(directions), 3 * num_vertices))
