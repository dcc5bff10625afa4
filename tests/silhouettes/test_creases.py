"""Reconstructions of bodies with sharp edges have sharp edges."""

import numpy as np
import pytest
import trimesh

from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.creases import has_creases
from nerfro.silhouettes.moving_mesh import MovingMesh
from nerfro.silhouettes.rims import find_rims, outlines_of
from nerfro.silhouettes.silhouette_fit import fit_surface
from tests.exact_silhouettes import cameras_around, hull, photographed_softly, volume


def box() -> trimesh.Trimesh:
    return trimesh.creation.box((1.2, 0.9, 0.7))


def tilt(mesh: TriangleMesh, normals: np.ndarray) -> float:
    """Mean angle of a surface to the nearest of some sides, degrees."""
    crosses = np.cross(*np.diff(mesh.triangles, axis=1).swapaxes(0, 1))
    area = np.linalg.norm(crosses, axis=1)
    cosines = (crosses @ normals.T).max(1) / area.clip(1e-12)
    return float(np.average(np.degrees(np.arccos(cosines.clip(-1, 1))), weights=area))


@pytest.mark.slow
def test_fitted_box_has_flat_sides_and_sharp_edges() -> None:
    """From 24 views of 80x80 pixels; with edges as marching cubes leave them its sides are off by 9 degrees."""
    silhouettes = photographed_softly(box(), cameras_around(24, 80))
    fitted = fit_surface(hull(silhouettes, 32), silhouettes)
    assert fitted.is_closed
    assert tilt(fitted, box().face_normals) < 0.8
    assert volume(fitted) == pytest.approx(box().volume, rel=0.01)


@pytest.mark.slow
def test_round_side_of_a_cylinder_stays_round() -> None:
    body = trimesh.creation.cylinder(0.6, 1.0, sections=120)
    silhouettes = photographed_softly(body, cameras_around(24, 80))
    fitted = fit_surface(hull(silhouettes, 32), silhouettes)
    radii = np.linalg.norm(fitted.vertices[np.abs(fitted.vertices[:, 2]) < 0.4, :2], axis=1)
    assert radii.mean() == pytest.approx(0.6, abs=0.004)
    assert radii.std() < 0.004
    caps = fitted.vertices[np.linalg.norm(fitted.vertices[:, :2], axis=1) < 0.5]
    assert np.abs(np.abs(caps[:, 2]) - 0.5).mean() < 0.006


def test_outlines_of_a_sharp_body_lie_at_its_edges() -> None:
    """Where normals that are smooth turn away is within the edge, by a tenth of a pixel here."""
    made = box().subdivide_to_size(0.05)
    seen = photographed_softly(box(), cameras_around(12, 80))
    rims = find_rims(MovingMesh(np.asarray(made.faces)).geometry(np.asarray(made.vertices)), seen, outlines_of(seen))
    off = rims.misfit / rims.width
    assert abs(np.median(off)) < 0.02
    assert np.median(np.abs(off)) < 0.04


@pytest.mark.parametrize("size", [2.0**-16, 2.0**10])
def test_normals_and_creases_are_independent_of_the_world_unit(size: float) -> None:
    made = trimesh.creation.icosphere(4)
    mesh = MovingMesh(np.asarray(made.faces))
    one, other = mesh.geometry(np.asarray(made.vertices)), mesh.geometry(size * np.asarray(made.vertices))
    np.testing.assert_array_equal(one.normals, other.normals)
    np.testing.assert_array_equal(one.creases, other.creases)


def test_only_sharp_bodies_have_creases() -> None:
    ball, sharp = trimesh.creation.icosphere(3), box().subdivide_to_size(0.1)
    for made, expected in ((ball, False), (sharp, True)):
        assert has_creases(MovingMesh(np.asarray(made.faces)).geometry(np.asarray(made.vertices))) is expected
