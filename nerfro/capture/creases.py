"""Sharp edges of a surface, which a fit that moves vertices along their normals leaves blunt."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import sparse

from nerfro.capture.moving_mesh import MovingMesh, Surface, solve_symmetric, unit
from nerfro.capture.rims import Rims

# A triangle takes the direction of its neighbours so often; directions that differ by this, radians, belong together.
_ROUNDS, _ALIKE = 3, 0.35
# Steps until edges are sharp.
STEPS = 12


class Sides(NamedTuple):
    """What is likely of a surface between its sharp edges, as weights for each observation of the outline."""

    flat: float  # triangles have their sides' directions
    staying: float  # vertices stay where they are


# Chosen on a box and on a cylinder; a prism with six sides confirms.
FACETS, CURVED = Sides(flat=1.0, staying=1e-5), Sides(flat=0.05, staying=1e-4)


def has_creases(surface: Surface) -> bool:
    """Whether its sharp edges, put end to end, are twice as long as the body."""
    ends = surface.vertices[surface.creases]
    return bool(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum() > 2 * np.ptp(surface.vertices, axis=0).max())


def sharpened(
    vertices: Float[np.ndarray, "V 3"],
    mesh: MovingMesh,
    rims_of: Callable[[Float[np.ndarray, "V 3"]], Rims],
    sides: Sides,
    step: Callable[[], None] = lambda: None,
) -> Float[np.ndarray, "V 3"]:
    """Vertices moved in any direction until sides are smooth, edges sharp, and outlines the masks'.

    Marching cubes cut an edge off by a row of triangles of neither side's direction. Each triangle first takes the
    direction of one side, see `_directions`. Then the linear least squares of the outlines and of

        sum_faces A_f sum_sides (m_f . (x_i - x_j))^2

    is solved, m_f that direction and A_f the area: vertices between two sides come to lie where these meet.

    Args:
        vertices: of a surface that is fitted, but blunt.
        mesh: its triangles.
        rims_of: where views see the outlines of vertices.
        sides: what is likely of them.
        step: is called after each of `STEPS` steps.
    """
    for _ in range(STEPS):
        vertices = _solved(vertices, mesh, rims_of(vertices), sides)
        step()
    return vertices


def _solved(vertices: Float[np.ndarray, "V 3"], mesh: MovingMesh, rims: Rims, sides: Sides) -> Float[np.ndarray, "V 3"]:
    direction, area = _directions(vertices, mesh)
    weight = np.sqrt(np.repeat(area / area.mean(), 3))
    flat = _projected_differences(
        (mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()),
        (weight, -weight),
        np.repeat(direction, 3, axis=0),
        len(vertices),
    )
    observed = _projected_differences(
        (rims.first, rims.second), (1 - rims.share, rims.share), rims.normal, len(vertices)
    )
    flatness, staying = len(rims.share) * sides.flat, len(rims.share) * sides.staying
    system = observed.T @ sparse.diags(rims.weight) @ observed + flatness * (flat.T @ flat)
    system += staying * sparse.identity(3 * len(vertices))
    right = observed.T @ (rims.weight * rims.misfit) - flatness * (flat.T @ (flat @ vertices.ravel()))
    right += staying * (mesh.spread(vertices) - vertices).ravel()
    step = solve_symmetric(system, right).reshape(-1, 3)
    longest = mesh.edge_length(vertices)
    return vertices + step * np.minimum(1, longest / np.linalg.norm(step, axis=1, keepdims=True).clip(1e-12))


def _directions(
    vertices: Float[np.ndarray, "V 3"], mesh: MovingMesh
) -> tuple[Float[np.ndarray, "F 3"], Float[np.ndarray, "F"]]:
    """Directions of triangles, each smoothed along its own side of an edge; and their areas.

    To which side a triangle belongs is told by the most even patch that it is in (guided normal filtering, Zhang et
    al. 2015): of those that reach over an edge, the one that does so least. On a round surface all are alike, and
    nothing is drawn flat there.
    """
    normals = mesh.face_normals(vertices)
    area, touching = np.linalg.norm(normals, axis=1), mesh.touching
    row, column = touching.row, touching.col
    patch = touching @ normals
    uneven = 1 - np.linalg.norm(patch, axis=1) / (touching @ area)
    order = np.lexsort((uneven[column], row))
    guide = unit(patch)[column[order[np.diff(row[order], prepend=-1) != 0]]]

    middle = vertices[mesh.faces].mean(1)
    apart = ((middle[row] - middle[column]) ** 2).sum(1)
    differing = ((guide[row] - guide[column]) ** 2).sum(1)
    near = area[column] * np.exp(-apart / (2 * apart[apart > 0].mean()) - differing / (2 * _ALIKE**2))
    averaging, direction = sparse.csr_matrix((near, (row, column)), touching.shape), unit(normals)
    for _ in range(_ROUNDS):
        direction = unit(averaging @ direction)
    return direction, area


def _projected_differences(
    ends: tuple[np.ndarray, np.ndarray],
    weights: tuple[np.ndarray, np.ndarray],
    directions: Float[np.ndarray, "R 3"],
    num_vertices: int,
) -> sparse.csr_matrix:
    """[R, 3V]: takes the coordinates of vertices to weighted sums of two of them along directions."""
    row = np.tile(np.repeat(np.arange(len(directions)), 3), 2)
    column = np.concatenate([(3 * end[:, None] + np.arange(3)).ravel() for end in ends])
    values = np.concatenate([(weight[:, None] * directions).ravel() for weight in weights])
    return sparse.csr_matrix((values, (row, column)), (len(directions), 3 * num_vertices))
