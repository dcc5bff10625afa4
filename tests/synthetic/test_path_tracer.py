"""The path tracer against closed forms: furnace, Snell's law, total reflection, camera and sky conventions."""

from dataclasses import replace

import numpy as np
import pytest

from nerfro.synthetic import path_tracer
from nerfro.synthetic.dataset import CAMERA_ANGLE_X, CAMERA_DISTANCE, directions_on_sphere, look_at_origin
from nerfro.synthetic.path_tracer import PathTracer, Pinhole, load_mitsuba
from nerfro.synthetic.scene import rounded_box, sphere, torus_angles
from nerfro.synthetic.synthesis import find_scene
from tests.conftest import refused
from tests.processes import python

IOR = 1.5


def white(directions):
    return np.ones(directions.shape)


@pytest.fixture(scope="module")
def white_torus():
    """The torus scene as a furnace: everything that scatters has albedo 1, light comes equally from everywhere."""
    scene = find_scene("torus").build(spacing=0.03)
    return replace(scene, sky=white, interior=replace(scene.interior, colours=np.ones_like(scene.interior.vertices)))


@pytest.fixture(scope="module")
def poses():
    return [look_at_origin(CAMERA_DISTANCE * direction) for direction in directions_on_sphere(3, 0, 0)]


def pixel_directions(pose, size):
    """Unit directions [H, W, 3] through the pixel centres of a pinhole camera with OpenGL axes."""
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    column, row = np.meshgrid(np.arange(size), np.arange(size))
    camera = np.stack([(column + 0.5 - size / 2) / focal, -(row + 0.5 - size / 2) / focal, -np.ones((size, size))], -1)
    directions = camera @ pose[:3, :3].T
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def trace(surface, origins, directions, crossings):
    """Follow rays through `transmitting_glass` alone; return directions and weights after `crossings` events."""
    mi = load_mitsuba()
    material = {"type": "transmitting_glass", "int_ior": IOR, "tint": mi.ScalarColor3f(0.5)}
    scene = mi.load_dict({"type": "scene", "glass": path_tracer.triangle_shape(mi, "glass", surface, material)})

    def columns(array):
        return [mi.Float(np.ascontiguousarray(column, np.float32)) for column in array.T]

    ray = mi.Ray3f(mi.Point3f(*columns(origins)), mi.Vector3f(*columns(directions)))
    weight = mi.Color3f(1.0)
    for _ in range(crossings):
        hit = scene.ray_intersect(ray)
        sample, value = hit.bsdf().sample(mi.BSDFContext(), hit, 0.5, mi.Point2f(0.5), hit.is_valid())
        ray = hit.spawn_ray(hit.to_world(sample.wo))
        weight = weight * value
    return np.asarray(ray.d).T, np.asarray(weight).T


def angle(first, second):
    """Angle in degrees between unit directions [R, 3], accurate for small ones."""
    return 2 * np.degrees(np.arcsin(np.clip(np.linalg.norm(first - second, axis=1) / 2, 0, 1)))


@pytest.mark.usefixtures("mitsuba")
def test_rays_through_a_ball_follow_snells_law():
    radius = 0.8
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sideways = np.cross(directions, generator.normal(size=(500, 3)))
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    sine = generator.uniform(0.05, 0.95, 500)
    origins = sine[:, None] * radius * sideways - 2 * directions
    deviation = 2 * (np.arcsin(sine) - np.arcsin(sine / IOR))[:, None]
    expected = np.cos(deviation) * directions - np.sin(deviation) * sideways
    found, weight = trace(sphere(radius, 6), origins, directions, crossings=2)
    assert np.median(angle(found, expected)) < 0.02
    assert weight == pytest.approx(0.25)  # the tint counts once per crossing, and nothing is scaled by n^2


@pytest.mark.usefixtures("mitsuba")
def test_ray_at_a_side_of_a_cube_is_reflected_totally():
    """Down through the top at 45 degrees, mirrored once at a side, out through the bottom: (x, y, z) -> (-x, y, z)."""
    heights = np.random.default_rng(1).uniform(-0.1, 0.1, 200)
    entry = np.stack([0.45 + heights, 3 * heights, np.full(200, 0.75)], -1)
    incoming = np.tile(np.array([np.sqrt(0.5), 0.0, -np.sqrt(0.5)]), (200, 1))
    box = rounded_box((0.75, 0.75, 0.75), 0.02, edge_steps=2)
    found, weight = trace(box, entry - incoming, incoming, crossings=3)
    assert angle(found, incoming * [-1, 1, 1]).max() < 0.01
    assert weight == pytest.approx(0.25)  # entering and leaving; total reflection loses nothing


@pytest.mark.parametrize("fresnel", [False, True])
@pytest.mark.usefixtures("mitsuba")
def test_white_furnace_is_white(white_torus, poses, fresnel, monkeypatch):
    monkeypatch.setattr(path_tracer, "SAMPLES_PER_PASS", 24 * 24 * 20)  # 32 samples are then two uneven passes
    tracer = PathTracer(white_torus, fresnel, Pinhole.square(CAMERA_ANGLE_X, 24))
    for seed, pose in enumerate(poses):
        picture = tracer.render(pose, spp=32, seed=seed)
        assert picture.mean() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.usefixtures("mitsuba")
def test_background_pixels_show_the_sky_in_the_direction_of_the_pixel(poses):
    """A sky that encodes the direction itself finds a mirrored, turned or shifted camera or sky."""
    ring, _ = torus_angles(0.05, 0.02, spacing=0.01)
    tiny = replace(ring, colours=np.ones_like(ring.vertices))
    scene = replace(
        find_scene("torus").build(0.1),
        glass=sphere(0.1, 3),
        interior=tiny,
        sky=lambda directions: 0.5 + 0.5 * directions,
    )
    tracer = PathTracer(scene, False, Pinhole.square(CAMERA_ANGLE_X, 16))
    for pose in poses:
        picture, background = tracer.render(pose, spp=256, seed=0), np.ones((16, 16), bool)
        background[6:10, 6:10] = False
        expected = 0.5 + 0.5 * pixel_directions(pose, 16)
        # Random positions within a pixel of 2.5 degrees: 0.5 * 0.043 / sqrt(12 * 256) = 4e-4 of noise.
        assert np.abs(picture - expected)[background].max() < 2e-3


@pytest.mark.slow
def test_missing_mitsuba_names_the_extra_to_install():
    """In a process of its own, which has not imported Mitsuba before."""
    code = "import sys; sys.modules['mitsuba'] = None; from nerfro.registry.registration import discover; discover()\n"
    code += "import nerfro.synthetic.path_tracer as t; t.load_mitsuba()"
    errors = python("-c", code).stderr
    assert "NerfroError" in errors
    assert "pip install 'nerfro[synthesize]'" in errors


def test_unknown_variant_names_the_known_variants():
    refused("choose auto, llvm_ad_rgb", load_mitsuba, "llvm")
