"""The synthetic scenes, and the shapes, viewpoints and skies that they are made of."""

import numpy as np
import pytest

from nerfro.core.light import to_srgb
from nerfro.registry.registration import discover
from nerfro.synthetic.dataset import directions_on_sphere, look_at_origin
from nerfro.synthetic.scene import lat_long_texture, rounded_box, sphere, torus_angles
from nerfro.synthetic.scenes import SCENES, distance
from nerfro.synthetic.synthesis import find_scene

discover()


def test_triangulation_lies_on_the_surface_and_faces_outward():
    centre, radius = np.array([0.1, -0.05, 0.02]), 0.3
    surface = distance.triangulate(lambda p: distance.ball(p, centre, radius), centre - 0.31, centre + 0.31, 0.02)
    outward = surface.vertices - centre
    assert np.linalg.norm(outward, axis=1) == pytest.approx(radius, abs=1e-5)
    assert surface.normals == pytest.approx(outward / radius, abs=1e-4)
    assert surface.as_trimesh().volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=1e-2)


@pytest.mark.parametrize(
    "solid",
    [
        lambda p: distance.block(p, (0.1, 0, 0), (0.4, 0.3, 0.2), 0.05),
        lambda p: distance.capsule(p, (-0.2, 0, 0), (0.3, 0.1, 0.2), 0.12, 0.05),
        lambda p: distance.ellipsoid(p, (0, 0, 0.1), (0.4, 0.2, 0.3)),
        lambda p: distance.star(p, 0.7, 0.35, 5),
        lambda p: distance.smooth_union([distance.ball(p, (x, 0, 0), 0.2) for x in (-0.15, 0.15)], 0.1),
    ],
    ids=["block", "capsule", "ellipsoid", "star", "smooth_union"],
)
def test_signed_distances_are_lipschitz_continuous(solid):
    """The bound that lets `triangulate` skip blocks."""
    generator = np.random.default_rng(0)
    points = generator.uniform(-0.8, 0.8, (4000, 3))
    steps = generator.normal(size=(4000, 3)) * 10.0 ** generator.uniform(-3, 0, (4000, 1))
    change = np.abs(solid(points + steps) - solid(points))
    assert (change <= np.linalg.norm(steps, axis=1) * (1 + 1e-9) + 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SCENES if name != "dolphin_capture"])
def test_scene_is_closed_inside_the_box_and_has_contrast(name):
    scene = find_scene(name).build(spacing=0.02)
    glass = scene.glass.as_trimesh()
    assert glass.is_watertight
    assert glass.volume > 0
    assert np.abs(scene.glass.vertices).max() < 0.9  # the box of the medium is [-1.5, 1.5]^3
    sample = scene.interior.vertices[:: max(1, len(scene.interior.vertices) // 500)]
    assert glass.contains(sample).all()
    assert scene.interior.as_trimesh().is_watertight
    assert scene.interior.as_trimesh().volume > 0
    assert scene.interior.colours.std(0).min() > 0.1
    sky = lat_long_texture(scene.sky, 32, 1)
    assert sky.min() >= 0
    assert sky.max() < 1  # 8-bit pictures never clip
    assert to_srgb(sky).std((0, 1)).min() > 0.1


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


def test_viewpoints_cover_the_whole_sphere_and_differ_between_splits():
    train, test = (directions_on_sphere(100, 0, split) for split in (0, 2))
    anywhere = np.random.default_rng(2).normal(size=(5000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    farthest = np.degrees(np.arccos((anywhere @ train.T).max(1))).max()
    assert farthest < 25  # 100 discs of 11.5 degrees would cover the sphere if they could be packed without overlap
    assert np.degrees(np.arccos(np.clip((test @ train.T).max(), -1, 1))) > 0.1
    assert np.array_equal(train, directions_on_sphere(100, 0, 0))
    assert not np.allclose(train, directions_on_sphere(100, 1, 0))


@pytest.mark.parametrize("position", [(3.0, -2.0, 1.0), (0.0, 0.0, 4.0), (0.0, 0.0, -4.0)])
def test_cameras_look_at_the_origin_upright(position):
    pose = look_at_origin(np.array(position))
    rotation = pose[:3, :3]
    assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert -rotation[:, 2] * np.linalg.norm(position) == pytest.approx(-np.array(position))
    assert rotation[2, 0] == pytest.approx(0.0, abs=1e-12)  # the picture's horizontal is horizontal
    assert rotation[2, 1] >= -1e-12


def test_lat_long_texture_averages_over_each_pixel():
    texture = lat_long_texture(lambda directions: np.repeat(directions[..., 2:] > 0, 3, -1).astype(float), 9, 3)
    assert texture[:4] == pytest.approx(1.0)
    assert texture[5:] == pytest.approx(0.0)
    assert texture[4] == pytest.approx(0.5, abs=0.2)  # the horizon runs through the middle of row 4
