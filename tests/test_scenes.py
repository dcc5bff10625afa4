"""The synthetic scenes, and the plugin package that holds most of them: solids and their triangulation."""

from importlib import import_module

import numpy as np
import pytest

from nerfro.light import to_srgb
from nerfro.registry import discover
from nerfro.synthetic import SCENES
from tests.synthetic.renderer import find_scene, lat_long_texture

discover()
distance = import_module("nerfro_plugins.synthetic_scenes.scenes.distance")


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
def test_distances_never_change_faster_than_the_way_travelled(solid):
    """The bound that lets `triangulate` skip blocks."""
    generator = np.random.default_rng(0)
    points = generator.uniform(-0.8, 0.8, (4000, 3))
    steps = generator.normal(size=(4000, 3)) * 10.0 ** generator.uniform(-3, 0, (4000, 1))
    change = np.abs(solid(points + steps) - solid(points))
    assert (change <= np.linalg.norm(steps, axis=1) * (1 + 1e-9) + 1e-12).all()


@pytest.mark.parametrize("name", [name for name in SCENES if name != "dolphin_capture"])
def test_scene_is_closed_inside_the_box_and_worth_looking_at(name):
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
