"""Shapes, viewpoints and skies that the synthetic scenes are made of."""

import numpy as np
import pytest

from nerfro.synthetic.surface import rounded_box, sphere, torus_angles
from nerfro.synthetic.viewpoints import look_at_origin


def assert_closed_and_outward(surface, volume, tolerance):
    mesh = surface.as_trimesh()
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=tolerance)
    facing = (mesh.face_normals[:, None] * surface.normals[surface.faces]).sum(-1)
    assert facing.min() > 0.9


def test_rounded_box_has_the_volume_of_steiners_formula():
    half_sides, radius = np.array([0.8, 0.5, 0.66]), 0.1
    a, b, c = 2 * (half_sides - radius)
    steiner = (
        a * b * c + 2 * (a * b + b * c + c * a) * radius + np.pi * (a + b + c) * radius**2 + 4 / 3 * np.pi * radius**3
    )
    surface = rounded_box(half_sides, radius, edge_steps=12)
    assert_closed_and_outward(surface, steiner, 1e-3)
    assert np.abs(surface.vertices).max(0) == pytest.approx(half_sides)


def test_sphere_and_torus_have_their_volumes():
    assert_closed_and_outward(sphere(0.8, 5), 4 / 3 * np.pi * 0.8**3, 2e-3)
    ring, angles = torus_angles(0.4, 0.15, spacing=0.015)
    assert_closed_and_outward(ring, 2 * np.pi**2 * 0.4 * 0.15**2, 5e-3)
    assert ((angles >= 0) & (angles < 2 * np.pi)).all()


@pytest.mark.parametrize("position", [(3.0, -2.0, 1.0), (0.0, 0.0, 4.0), (0.0, 0.0, -4.0)])
def test_cameras_look_at_the_origin_upright(position):
    pose = look_at_origin(np.array(position))
    rotation = pose[:3, :3]
    assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert -rotation[:, 2] * np.linalg.norm(position) == pytest.approx(-np.array(position))
    assert rotation[2, 0] == pytest.approx(0.0, abs=1e-12)  # the picture's horizontal is horizontal
    assert rotation[2, 1] >= -1e-12
