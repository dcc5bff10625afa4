"""Images of empty glass under a known sky: all branches of rays against the path tracer of Mitsuba."""

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
from nerfro.synthetic.dataset import look_at_origin
from nerfro.synthetic.path_tracer import PathTracer, Pinhole
from nerfro.synthetic.scene import SurfaceMesh, rounded_box, sphere
from tests.cameras_at import cameras_at
from tests.closed_forms import Ball, RoundedBox, grid_points, sampled
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
        return seen(path, medium.with_absorption(path).transmitted(path.far[:, None])[:, 0])

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
