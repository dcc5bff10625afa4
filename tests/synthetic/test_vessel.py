"""A glass half full of water, made of Mitsuba's own shapes and dielectrics, against the rays of a vessel."""

from types import ModuleType

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor
from torch.nn.functional import normalize

from nerfro.core.rays import Rays
from nerfro.media.bodies import Bodies
from nerfro.media.vessel import make_vessel
from nerfro.samplers.paths.snell import Snell
from tests.closed_forms import angle, make_rays

RADIUS, HEIGHT, WALL, FOOT, LEVEL = 0.5, 1.6, 0.06, 0.16, 0.8
GLASS, WATER, AIR = 1.5, 1.33, 1.0
GRID = {"resolution": 96, "box_min": [-1.0] * 3, "box_max": [1.0] * 3, "cache": False}
NUM_RAYS, MAX_EVENTS = 4000, 16
VOXEL, STEADY = 0.02, 5.0  # world units, degrees


@pytest.fixture(scope="module")
def mesh(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The outside of the glass as silhouettes show it: a cylinder from z = -0.8 to 0.8."""
    file = tmp_path_factory.mktemp("glass") / "glass.ply"
    trimesh.creation.cylinder(RADIUS, HEIGHT, sections=512).export(file)
    return str(file)


@pytest.fixture(scope="module")
def rays() -> Rays:
    """To points spread through the glass, from a distance of 4, from level with its middle to 57 degrees above."""
    random = torch.Generator().manual_seed(0)
    turn, raised, radius, other, z = torch.rand(5, NUM_RAYS, generator=random, dtype=torch.float64)
    eyes = 4 * torch.stack([raised.cos() * (6.28 * turn).cos(), raised.cos() * (6.28 * turn).sin(), raised.sin()], -1)
    wide = RADIUS * radius.sqrt()
    targets = torch.stack([wide * (6.28 * other).cos(), wide * (6.28 * other).sin(), (z - 0.5) * HEIGHT], -1)
    return make_rays(eyes, normalize(targets - eyes, dim=-1), 0.5, 9.0)


@pytest.fixture(scope="module")
def by_mitsuba(mitsuba: ModuleType, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """Exit directions; which rays pass through water; and which of these rays are not near an edge.

    Near an edge, and after several total reflections, the paths of rays one voxel apart differ.
    """
    dry, wet = _interfaces(mitsuba)
    axes = torch.eye(3, dtype=torch.float64)
    shifts = VOXEL * torch.cat([torch.zeros(1, 3, dtype=torch.float64), axes, -axes])
    origins, directions = (rays.origins + shifts[:, None]).flatten(0, 1), rays.directions.repeat(len(shifts), 1)
    traced, reached_water = _trace(mitsuba, make_rays(origins, directions, 0.5, 9.0), dry, wet)
    found, *beside = traced.split(len(rays))
    through_water = reached_water[: len(rays)]
    steady = torch.stack([angle(each, found) < STEADY for each in beside]).all(0)
    return found, through_water, through_water & steady


def _trace(mi: ModuleType, rays: Rays, dry: dict[str, object], wet: dict[str, object]) -> tuple[Tensor, Tensor]:
    import drjit as dr

    scene, of_water = (mi.load_dict({"type": "scene"} | parts) for parts in (dry | wet, wet))
    o, d = (
        [mi.Float(np.ascontiguousarray(column, np.float32)) for column in part.T.numpy()]
        for part in (rays.origins, rays.directions)
    )
    ray, through_water = mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d)), np.zeros(len(rays), bool)
    for _ in range(MAX_EVENTS):
        hit = scene.ray_intersect(ray)
        at_water = np.isclose(np.asarray(hit.t), np.asarray(of_water.ray_intersect(ray).t))
        through_water |= at_water & np.asarray(hit.is_valid())
        # A random number of one is above every partial reflectance: light is transmitted, or reflected totally.
        sample, _ = hit.bsdf().sample(mi.BSDFContext(), hit, 1.0, mi.Point2f(0.5), hit.is_valid())
        ray = dr.select(hit.is_valid(), hit.spawn_ray(hit.to_world(sample.wo)), ray)
    left = ~np.asarray(scene.ray_test(ray))
    return torch.from_numpy(np.asarray(ray.d).T.astype(np.float64)), torch.from_numpy(through_water & left)


def _interfaces(mi: ModuleType) -> tuple[dict[str, object], dict[str, object]]:
    """Surfaces between two materials each, those of water apart; normals point from `inside` to `outside`."""
    low, top, inner = -0.5 * HEIGHT, 0.5 * HEIGHT, RADIUS - WALL
    foot, level = low + FOOT, low + LEVEL

    def between(inside: float, outside: float, shape: dict[str, object]) -> dict[str, object]:
        return {**shape, "bsdf": {"type": "dielectric", "int_ior": inside, "ext_ior": outside}}

    def tube(radius: float, bottom: float, brim: float) -> dict[str, object]:
        return {"type": "cylinder", "radius": radius, "p0": [0, 0, bottom], "p1": [0, 0, brim]}

    def plate(radius: float, z: float, looks_up: bool) -> dict[str, object]:
        at = mi.ScalarTransform4f().translate([0, 0, z]).scale([radius, radius, 1])
        return {"type": "disk", "to_world": at, "flip_normals": not looks_up}

    rim = trimesh.creation.annulus(inner, RADIUS, 1e-6, sections=512)
    ring = rim.faces[rim.face_normals[:, 2] > 0.5]
    brim = mi.Mesh("brim", len(rim.vertices), len(ring), props=_with_bsdf(mi, between(GLASS, AIR, {})["bsdf"]))
    parameters = mi.traverse(brim)
    parameters["vertex_positions"] = (rim.vertices + np.array([0, 0, top])).astype(np.float32).ravel()
    parameters["faces"] = ring.astype(np.uint32).ravel()
    parameters.update()
    dry = {
        "outside": between(GLASS, AIR, tube(RADIUS, low, top)),
        "below": between(GLASS, AIR, plate(RADIUS, low, looks_up=False)),
        "brim": brim,
        "wall": between(AIR, GLASS, tube(inner, level, top)),
    }
    wet = {
        "wet_wall": between(WATER, GLASS, tube(inner, foot, level)),
        "wet_foot": between(WATER, GLASS, plate(inner, foot, looks_up=False)),
        "level": between(WATER, AIR, plate(inner, level, looks_up=True)),
    }
    return dry, wet


def _with_bsdf(mi: ModuleType, material: object) -> object:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(material)
    return properties


def _errors(medium: Bodies, rays: Rays, by_mitsuba: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Angles to Mitsuba's directions, degrees: of rays through the water, and of those far from edges."""
    directions, through_water, steady = by_mitsuba
    errors = angle(Snell()(rays, medium).exit_directions.double(), directions)
    return errors[through_water], errors[steady]


@pytest.mark.slow
def test_rays_through_a_half_full_glass_match_mitsuba(
    mesh: str, rays: Rays, by_mitsuba: tuple[Tensor, Tensor, Tensor]
) -> None:
    _, through_water, steady = by_mitsuba
    assert through_water.float().mean() > 0.5
    assert steady.float().mean() > 0.2
    glass = make_vessel(mesh, WALL, FOOT, LEVEL, ior=GLASS, liquid_ior=WATER, **GRID)
    errors, errors_far_from_edges = _errors(glass, rays, by_mitsuba)
    assert errors.median() < 0.03
    assert errors_far_from_edges.median() < 0.01
    # The grid rounds the brim, the foot and the line where the level meets the wall.
    assert errors_far_from_edges.quantile(0.8) < 0.1
