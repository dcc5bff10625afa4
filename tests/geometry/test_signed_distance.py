"""Signed distances of meshes against closed forms and brute force."""

import numpy as np
import trimesh

from nerfro.geometry.signed_distance import distance_to_set, signed_distance_grid
from tests.geometry.test_bodies import mesh_of

BOX = np.array([[-1.0] * 3, [1.0] * 3])
SIZE = 41


def _points() -> np.ndarray:
    axis = np.linspace(-1, 1, SIZE)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)


def test_facets_of_a_sphere_do_not_show() -> None:
    radius = 0.6
    mesh = mesh_of(trimesh.creation.icosphere(3, radius))
    sagitta = radius - np.linalg.norm(mesh.triangles.mean(1), axis=1).min()
    distance = signed_distance_grid(mesh, BOX, SIZE, band=3.0)
    exact = np.linalg.norm(_points(), axis=-1) - radius
    near = np.abs(exact) < 2 * 2 / (SIZE - 1)
    assert np.abs(distance - exact)[near].max() < 0.2 * sagitta


def test_sharp_edges_stay_sharp() -> None:
    half = 0.53
    mesh = mesh_of(trimesh.creation.box(extents=[2 * half] * 3))
    distance = signed_distance_grid(mesh, BOX, SIZE, band=3.0)
    q = np.abs(_points()) - half
    exact = np.linalg.norm(q.clip(0), axis=-1) + q.max(-1).clip(max=0)
    near = np.abs(exact) < 2.5 * 2 / (SIZE - 1)
    np.testing.assert_allclose(distance[near], exact[near], atol=1e-6)


def test_far_values_are_lower_bounds_of_the_right_sign() -> None:
    mesh = mesh_of(trimesh.creation.torus(0.6, 0.25, 64, 32))
    distance = signed_distance_grid(mesh, BOX, SIZE, band=2.0)
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
