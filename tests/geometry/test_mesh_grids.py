"""Occupancy and signed distances of meshes on grids, against closed forms and brute force."""

import numpy as np
import pytest
import trimesh

from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.occupancy import occupancy_fraction
from nerfro.geometry.signed_distance import distance_to_set, signed_distance_grid
from tests.geometry.test_bodies import mesh_of

BOX = np.array([[-1.5] * 3, [1.5] * 3])


def _winding_number(points: np.ndarray, mesh: TriangleMesh) -> np.ndarray:
    """Bodies angle of the mesh over 4 pi: Van Oosterom and Strackee (1983), Eqn. 8."""
    a, b, c = (mesh.triangles[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    volume = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    scale = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.arctan2(volume, scale).sum(-1) / (2 * np.pi)


@pytest.mark.slow
def test_fractions_are_counts_of_sub_samples_inside_by_winding_number() -> None:
    mesh = mesh_of(trimesh.creation.annulus(0.4, 0.9, 0.7))
    size = 12
    axis = np.linspace(-1.5, 1.5, size)
    offsets = np.linspace(-1, 1, 4) * (axis[1] - axis[0])
    fine = (axis[:, None] + offsets).reshape(-1)
    points = np.stack(np.meshgrid(fine, fine, fine, indexing="ij"), -1).reshape(-1, 3)
    # No sub-sample lies on the surface, where inside is a matter of taste.
    points = points + 0
    inside = np.concatenate([_winding_number(part, mesh) for part in np.array_split(points, 40)]) > 0.5
    counts = inside.reshape(size, 4, size, 4, size, 4).sum((1, 3, 5))
    np.testing.assert_allclose(occupancy_fraction(mesh, BOX, size), counts / 64, atol=1e-6)


def test_columns_through_edges_and_vertices_are_counted_once() -> None:
    # All vertices, edges and diagonals of this cube project onto columns of the grid.
    mesh = mesh_of(trimesh.creation.box(extents=[1.0, 1.0, 1.0]))
    box = np.array([[-1.0] * 3, [1.0] * 3])
    occupancy = occupancy_fraction(mesh, box, 17, subsamples=1)
    assert set(np.unique(occupancy)) == {0.0, 1.0}
    # Half-open: of two opposite faces that lie on grid planes one belongs to the inside.
    assert occupancy.sum() == 8**3


def test_hole_is_outvoted_by_the_other_axes() -> None:
    sphere = trimesh.creation.icosphere(4, 0.8)
    # The cap around +z is missing: columns along z that pass through it see a single crossing.
    sphere.update_faces(sphere.triangles_center[:, 2] < 0.75)
    mesh = mesh_of(sphere)
    assert not mesh.is_closed
    occupancy = occupancy_fraction(mesh, BOX, 33)
    assert occupancy[16, 16, 16] == 1
    assert occupancy[16, 16, 30] == 0
    assert occupancy.sum() * (3 / 32) ** 3 == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.02)


CUBE = np.array([[-1.0] * 3, [1.0] * 3])
SIZE = 41


def _points() -> np.ndarray:
    axis = np.linspace(-1, 1, SIZE)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)


def test_distances_of_a_sphere_are_free_of_facets() -> None:
    radius = 0.6
    mesh = mesh_of(trimesh.creation.icosphere(3, radius))
    sagitta = radius - np.linalg.norm(mesh.triangles.mean(1), axis=1).min()
    distance = signed_distance_grid(mesh, CUBE, SIZE, band=3.0)
    exact = np.linalg.norm(_points(), axis=-1) - radius
    near = np.abs(exact) < 2 * 2 / (SIZE - 1)
    assert np.abs(distance - exact)[near].max() < 0.2 * sagitta


def test_distances_preserve_sharp_edges() -> None:
    half = 0.53
    mesh = mesh_of(trimesh.creation.box(extents=[2 * half] * 3))
    distance = signed_distance_grid(mesh, CUBE, SIZE, band=3.0)
    q = np.abs(_points()) - half
    exact = np.linalg.norm(q.clip(0), axis=-1) + q.max(-1).clip(max=0)
    near = np.abs(exact) < 2.5 * 2 / (SIZE - 1)
    np.testing.assert_allclose(distance[near], exact[near], atol=1e-6)


def test_far_values_are_lower_bounds_of_the_right_sign() -> None:
    mesh = mesh_of(trimesh.creation.torus(0.6, 0.25, 64, 32))
    distance = signed_distance_grid(mesh, CUBE, SIZE, band=2.0)
    p = _points()
    exact = np.hypot(np.hypot(p[..., 0], p[..., 1]) - 0.6, p[..., 2]) - 0.25
    far = np.abs(exact) > 3 * 2 / (SIZE - 1)
    spacing = 2 / (SIZE - 1)
    tessellation = 2e-3
    assert (np.sign(distance[far]) == np.sign(exact[far])).all()
    assert (np.abs(distance[far]) <= np.abs(exact[far]) + tessellation).all()
    assert (np.abs(distance[far]) >= np.abs(exact[far]) - np.sqrt(3) * spacing - tessellation).all()


def test_distance_to_a_set_is_the_least_of_all_distances() -> None:
    generator = np.random.default_rng(0)
    members = generator.random((9, 11, 7)) < 0.02
    spacing = np.array([0.5, 1.0, 2.0])
    points = np.argwhere(members) * spacing
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in members.shape), indexing="ij"), -1) * spacing
    brute = np.linalg.norm(grid[..., None, :] - points, axis=-1).min(-1)
    np.testing.assert_allclose(distance_to_set(members, spacing), brute, rtol=1e-6)
