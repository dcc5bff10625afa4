"""Pictures of empty glass under a known sky: all branches of our rays against Mitsuba's path tracing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.light import to_srgb
from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.shapes import Ball, RoundedBox
from nerfro.media.solid import Solid
from nerfro.models.base import psnr
from nerfro.pixel_parts import part_rays
from nerfro.samplers.snell import Snell
from nerfro.scenes import path_tracer, torus
from nerfro.scenes.path_tracer import PathTracer, Pinhole
from nerfro.scenes.surface import Surface, rounded_box, sphere, torus_angles
from nerfro.scenes.viewpoints import look_at_origin
from nerfro.types import Path

SIDE, ANGLE, SPP, PARTS = 28, 0.5, 2048, 7
POSE = look_at_origin(np.array([2.6, 2.2, 2.0]))
COLOURED = (0.2, 0.5, 1.1)
BRANCHES = Snell(branches="all", least_weight=0.002)
CUBE = rounded_box((0.6, 0.6, 0.6), 0.1, edge_steps=24)


def sky(directions: np.ndarray) -> np.ndarray:
    """Two lamps, some 40 and 6 times as bright as white, in a smooth sky."""
    radiance = 0.3 + 0.15 * directions + 0.1 * np.sin(3 * directions[..., [1, 2, 0]])
    for towards, width, colour in (
        ((0.3, -0.7, 0.65), 0.12, (40.0, 36.0, 30.0)),
        ((-0.8, 0.1, 0.6), 0.25, (2.0, 4.0, 6.0)),
    ):
        unit = np.asarray(towards) / np.linalg.norm(towards)
        radiance = radiance + np.exp((directions @ unit - 1) / width**2)[..., None] * np.asarray(colour)
    return radiance


def path_traced(
    glass: Surface, ior: float, absorption: tuple[float, float, float] = (0, 0, 0), inner: tuple | None = None
) -> Tensor:
    """Linear radiance by Mitsuba; `inner` is the surface and the index of a body inside."""
    pytest.importorskip("mitsuba")
    ring, _ = torus_angles(0.02, 0.005, spacing=0.005)
    # Far outside the picture, as scenes have an interior.
    interior = replace(ring, vertices=ring.vertices + np.float32(50), colours=np.ones_like(ring.vertices))
    scene = replace(
        torus.build(0.1), glass=glass, interior=interior, ior=ior, tint=(1.0,) * 3, absorption=absorption, sky=sky
    )
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
                "inner": path_tracer._mesh(mi, "inner", surface, material),
            }
        )
    return torch.from_numpy(tracer.render(POSE, SPP, seed=1))


def rays_of_picture() -> tuple:
    focal = torch.tensor([float(Pinhole.square(ANGLE, SIDE).focal)])
    middle = torch.tensor([0.5 * SIDE])
    pose = torch.from_numpy(POSE[None, :3]).float()
    cameras = Cameras(pose, focal, focal, middle, middle, SIDE, SIDE, 1.0, 6.0)
    return part_rays(cameras, torch.arange(SIDE**2), PARTS)


def seen(path: Path, transmitted: Tensor | float = 1.0) -> Tensor:
    """Linear radiance of a picture of traced rays."""
    radiance = torch.from_numpy(sky(path.exit_directions.double().numpy())).float()
    return path.per_ray(radiance * transmitted).view(SIDE, SIDE, PARTS**2, 3).mean(2)


def agreement(found: Tensor, expected: Tensor) -> float:
    return float(psnr(*(to_srgb(picture.clamp(0, 1)) for picture in (found, expected))))


def _saved(folder: FilePath, **surfaces: Surface) -> list[str]:
    for name, surface in surfaces.items():
        surface.save(folder / f"{name}.ply")
    return [str(folder / f"{name}.ply") for name in surfaces]


@pytest.mark.parametrize("what", ["ball", "cube", "bottle"])
def test_pictures_of_empty_glass_are_those_of_a_dielectric(what: str, tmp_path: FilePath) -> None:
    medium: Solid
    sampler, inner, ior = BRANCHES, None, 1.5
    if what == "ball":
        glass, medium = sphere(0.7, 6), Ball(0.7, ior)
    elif what == "cube":
        glass, medium = CUBE, RoundedBox(0.6, 0.1, ior)
    else:
        glass, water = rounded_box((0.45, 0.45, 0.7), 0.2, 12), rounded_box((0.33, 0.33, 0.5), 0.12, 12)
        inner = water, 1.33
        outer_file, inner_file = _saved(tmp_path, outer=glass, inner=water)
        medium = SdfGrid(
            outer_file, ior, [inner_file], [1.33], 64, [-0.9] * 3, [0.9] * 3, crease_degrees=60, cache=False
        )
        sampler = Snell("mesh", branches="all", least_weight=0.002)
    expected = path_traced(glass, ior, inner=inner)
    found = agreement(seen(sampler(rays_of_picture(), medium)), expected)
    assert found > 35
    # Light that is left out is seen, and so is what was reflected once.
    single, once = (agreement(seen(Snell("mesh" if inner else "sdf", branches=b)(rays_of_picture(), medium)), expected)
                    for b in ("none", "first"))  # type: ignore[arg-type]  # fmt: skip
    assert single < once < found
    assert single < 30


@pytest.mark.parametrize("what", ["ball", "cube"])
def test_absorption_is_that_of_the_path_and_is_learned_from_a_picture(what: str) -> None:
    glass = sphere(0.7, 6) if what == "ball" else CUBE

    def medium(**options: object) -> Solid:
        return Ball(0.7, 1.5, **options) if what == "ball" else RoundedBox(0.6, 0.1, 1.5, **options)  # type: ignore[arg-type]

    expected = path_traced(glass, 1.5, COLOURED).float()
    given = medium(absorption=list(COLOURED))
    path = given.tinted(BRANCHES(rays_of_picture(), given))
    assert agreement(seen(path, path.transmitted(path.far[:, None])[:, 0]), expected) > 35
    learner = medium(learn_absorption=True)
    assert float(learner.absorption.max()) < 0.03  # type: ignore[union-attr]
    optimizer = torch.optim.Adam(learner.parameters(), lr=0.1)
    for _ in range(150):
        path = learner.tinted(path)
        picture = seen(path, path.transmitted(path.far[:, None])[:, 0])
        loss = (to_srgb(picture) - to_srgb(expected)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert torch.tensor(list(learner.learned().values())) == pytest.approx(torch.tensor(COLOURED), rel=0.05)


def test_a_dispersive_cube_is_that_of_three_colours() -> None:
    medium = RoundedBox(0.6, 0.1, 1.5, abbe=[15.0])
    iors = [float(medium.at_wavelength(wavelength).iors) for wavelength in BRANCHES.wavelengths]
    assert iors[2] - iors[0] > 0.03
    expected = torch.stack([path_traced(CUBE, ior)[..., colour] for colour, ior in enumerate(iors)], -1)
    found = agreement(seen(BRANCHES(rays_of_picture(), medium)), expected)
    clear = agreement(seen(BRANCHES(rays_of_picture(), RoundedBox(0.6, 0.1, 1.5))), expected)
    assert found > 35
    assert clear < found - 5
