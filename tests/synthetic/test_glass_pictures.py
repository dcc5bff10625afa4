"""Images of empty glass against the path tracer of Mitsuba, and the path tracer against closed forms."""

from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfro.core.light import to_srgb
from nerfro.core.types import Path, Rays
from nerfro.evaluation.image_metrics import psnr
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.samplers.subdivision import part_rays
from nerfro.synthetic import path_tracer
from nerfro.synthetic.dataset import CAMERA_ANGLE_X, CAMERA_DISTANCE, directions_on_sphere, look_at_origin
from nerfro.synthetic.path_tracer import PathTracer, Pinhole, load_mitsuba
from nerfro.synthetic.scene import SurfaceMesh, rounded_box, sphere, torus_angles
from nerfro.synthetic.synthesis import find_scene
from tests.cameras_at import cameras_at
from tests.closed_forms import Ball, RoundedBox, grid_points, sampled
from tests.conftest import refused
from tests.processes import python
from tests.reference_tracer import Snell
from tests.synthetic.empty_glass import empty_glass

# Sums over a pixel of a cube converge slowly: an edge sees lamps in many directions.
SIDE, ANGLE, SPP, PARTS = 12, 0.5, 4096, 16
POSE = look_at_origin(np.array([2.6, 2.2, 2.0]))
COLOURED = (0.4, 0.8, 1.4)
BRANCHES = Snell(branches="all", least_weight=0.002, max_events=32)
BOX = torch.tensor([[-0.9] * 3, [0.9] * 3])
BALL, CUBE = sphere(0.7, 6), rounded_box((0.55, 0.55, 0.55), 0.2, edge_steps=24)


def sky(directions: np.ndarray) -> np.ndarray:
    """Two lamps, some 12 and 6 times as bright as white, in a smooth sky."""
    radiance = 0.3 + 0.15 * directions + 0.1 * np.sin(3 * directions[..., [1, 2, 0]])
    for towards, width, colour in (
        ((0.3, -0.7, 0.65), 0.2, (12.0, 10.0, 9.0)),
        ((-0.8, 0.1, 0.6), 0.3, (2.0, 4.0, 6.0)),
    ):
        unit = np.asarray(towards) / np.linalg.norm(towards)
        radiance = radiance + np.exp((directions @ unit - 1) / width**2)[..., None] * np.asarray(colour)
    return radiance


def path_traced(
    glass: SurfaceMesh, ior: float, absorption: tuple[float, float, float] = (0, 0, 0), inner: tuple | None = None
) -> Tensor:
    """Linear radiance by Mitsuba; `inner` is the surface and the index of a body inside."""
    scene = empty_glass(glass, sky, ior=ior, absorption=absorption)
    tracer = PathTracer(scene, True, Pinhole.square(ANGLE, SIDE))
    if inner is not None:
        mi, (surface, index) = tracer.mitsuba, inner
        material = {"type": "dielectric", "int_ior": index, "ext_ior": ior}
        shapes = {shape.id(): shape for shape in tracer.scene.shapes()}
        tracer.scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": tracer.scene.integrator(),
                "sky": tracer.scene.environment(),
                **shapes,
                "inner": path_tracer.triangle_shape(mi, "inner", surface, material),
            }
        )
    return torch.from_numpy(tracer.render(POSE, SPP, seed=1))


def on_grid(what: str, **glass: list[float] | bool) -> Bodies:
    """The ball or the cube on a grid, for the compiled kernel."""
    shape = Ball(0.7) if what == "ball" else RoundedBox(0.55, 0.2)
    points = grid_points(0.9, 96)
    return sampled(shape.signed_distances(points)[0].movedim(-1, 0), BOX, [1.5], 0.02, **glass)


def rays_of_picture(parts: int = PARTS) -> Rays:
    cameras = cameras_at(POSE[None, :3], SIDE, SIDE, Pinhole.square(ANGLE, SIDE).focal, near=1.0)
    return part_rays(cameras, torch.arange(SIDE**2), parts)


def seen(path: Path, transmitted: Tensor | float = 1.0) -> Tensor:
    """Linear radiance of a picture of traced rays."""
    radiance = torch.from_numpy(sky(path.exit_directions.double().numpy())).float()
    return path.sum_polylines(radiance * transmitted).view(SIDE, SIDE, -1, 3).mean(2)


def agreement(found: Tensor, expected: Tensor) -> float:
    """PSNR of pictures as they are shown, dB."""
    return float(psnr(*(to_srgb(picture.clamp(0, 1)) for picture in (found, expected))))


@pytest.mark.slow
@pytest.mark.usefixtures("mitsuba")
@pytest.mark.parametrize("what", ["ball", "cube", "bottle"])
def test_images_of_empty_glass_match_the_dielectric_of_mitsuba(what: str, tmp_path: FilePath) -> None:
    interface, inner, glass = "sdf", None, BALL if what == "ball" else CUBE
    if what == "bottle":
        interface, glass, water = "mesh", *(rounded_box((a, a, b), 0.2, 12) for a, b in ((0.45, 0.7), (0.33, 0.5)))
        inner = water, 1.33
        glass.save(tmp_path / "glass.ply")
        water.save(tmp_path / "water.ply")
        meshes = {"glass.ply": 1.5, "water.ply": 1.33}
        bodies = {name[:5]: {"mesh": str(tmp_path / name), "ior": ior} for name, ior in meshes.items()}
        box = {"box_min": BOX[0].tolist(), "box_max": BOX[1].tolist()}
        medium = make_bodies(bodies=bodies, resolution=48, cache=False, **box)
    else:
        medium = on_grid(what)
    expected, rays = path_traced(glass, 1.5, inner=inner), rays_of_picture()

    def score(branches: str) -> float:
        sampler = Snell(interface, 32, branches, 0.002)  # type: ignore[arg-type]
        return agreement(seen(sampler(rays, medium)), expected)

    single, once, every = (score(branches) for branches in ("none", "first", "all"))
    assert every > 35
    # Light that is left out is missed, and so is what is reflected later.
    assert single < once < every
    assert single < every - 3


@pytest.mark.slow
@pytest.mark.usefixtures("mitsuba")
@pytest.mark.parametrize("what", ["ball", "cube"])
def test_absorption_matches_the_path_tracer_and_is_learned_from_an_image(what: str) -> None:
    expected = path_traced(BALL if what == "ball" else CUBE, 1.5, COLOURED).float()
    given, learner = on_grid(what, absorption=list(COLOURED)), on_grid(what, learn=["absorption"])

    def picture(medium: Bodies, path: Path) -> Tensor:
        return seen(path, medium.with_absorption(path).whole_transmittance())

    assert agreement(picture(given, BRANCHES(rays_of_picture(), given)), expected) > 35
    few = BRANCHES(rays_of_picture(8), given)
    assert max(learner.measurements().values()) < 0.03
    optimizer = torch.optim.Adam(learner.parameters(), lr=0.15)
    for _ in range(160):
        loss = (to_srgb(picture(learner, few)) - to_srgb(expected)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    torch.testing.assert_close(
        torch.tensor(list(learner.measurements().values())), torch.tensor(COLOURED), rtol=0.05, atol=0
    )


@pytest.mark.usefixtures("mitsuba")
def test_dispersive_cube_matches_the_path_tracer_at_three_wavelengths() -> None:
    medium, rays = on_grid("cube", abbe=5.0), rays_of_picture()
    iors = [float(medium.at_wavelength(wavelength).iors) for wavelength in BRANCHES.wavelengths]
    assert iors[2] - iors[0] > 0.1
    expected = torch.stack([path_traced(CUBE, ior)[..., colour] for colour, ior in enumerate(iors)], -1)
    found, of_one_index = (agreement(seen(BRANCHES(rays, cube)), expected) for cube in (medium, on_grid("cube")))
    assert found > 35
    assert of_one_index < found - 5


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
