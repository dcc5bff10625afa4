"""Surfaces of bodies: distances and refraction against closed forms, and their settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies, origin_of
from nerfro.registry.registration import discover
from nerfro.samplers.paths.snell import Snell
from tests.closed_forms import angle, make_rays
from tests.conftest import refused

FAR = [0.5, 0.0, -1e6]
AXIS = torch.tensor([1.0, 2.0, 2.0]).double() / 3
HALF_CIRCLE = [[math.cos(t), math.sin(t)] for t in np.linspace(-1.5, 1.5, 33) * math.pi / 3]
TUBE = [[0.7 + 0.3 * math.cos(t), 0.3 * math.sin(t)] for t in np.linspace(0, 2 * math.pi, 33)[:-1]]


def _ball(x: Tensor) -> Tensor:
    return x.norm(dim=-1) - 1


def _box(x: Tensor) -> Tensor:
    excess = (x - torch.tensor([0.1, 0.0, 0.2])).abs() - torch.tensor([0.8, 0.5, 0.2]) + 0.15
    return excess.clamp(min=0).norm(dim=-1) + excess.amax(-1).clamp(max=0) - 0.15


def _cylinder(x: Tensor) -> Tensor:
    height = (x @ AXIS - 0.5).abs()
    excess = torch.stack([(x - (x @ AXIS)[..., None] * AXIS).norm(dim=-1) - 0.4, height - 0.5], -1)
    return excess.clamp(min=0).norm(dim=-1) + excess.amax(-1).clamp(max=0)


def _torus(x: Tensor) -> Tensor:
    return torch.hypot(torch.hypot(x[..., 0], x[..., 1]) - 0.7, x[..., 2]) - 0.3


def _medium(surface: Any, resolution: int = 48, **settings: Any) -> Bodies:
    return make_bodies(
        bodies={"body": {"surface": surface, "ior": 1.5, **settings}}, resolution=resolution, cache=False
    )


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    discover()
    trimesh.creation.icosphere(4, 1.0).export("ball.ply")
    axes = [np.linspace(-side, side, count) for side, count in ((1.2, 64), (1.2, 60), (0.6, 40))]
    x = torch.from_numpy(np.stack(np.meshgrid(*axes, indexing="ij"), -1))
    np.savez("torus.npz", distances=_torus(x).numpy(), box=np.array([[-1.2, -1.2, -0.6], [1.2, 1.2, 0.6]]))


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(
    ("surface", "distance", "error"),
    [
        ({"name": "mesh", "file": "ball.ply"}, _ball, 2e-5),
        ({"name": "ball", "radius": 0.5, "centre": FAR}, lambda x: (x - torch.tensor(FAR)).norm(dim=-1) - 0.5, 2e-5),
        ({"name": "box", "sides": [1.6, 1.0, 0.4], "centre": [0.1, 0, 0.2], "rounding": 0.15}, _box, 2e-4),
        ({"name": "revolution", "profile": HALF_CIRCLE}, _ball, 3e-5),
        ({"name": "revolution", "profile": HALF_CIRCLE[::-1], "axis": [2.0, 0.0, 1.0]}, _ball, 3e-5),
        ({"name": "revolution", "profile": [[0.4, 0], [0.4, 1]], "axis": [1, 2, 2]}, _cylinder, 1e-4),
        ({"name": "revolution", "profile": [*TUBE, TUBE[0]]}, _torus, 1e-4),
        ({"name": "grid", "file": "torus.npz"}, _torus, 1e-4),
        ({"name": "torus", "radius": 0.7}, _torus, 1e-4),
        ({"name": "offset", "surface": {"name": "mesh", "file": "ball.ply"}, "distance": 0.3},
         lambda x: _ball(x) - 0.3, 1e-4),
        ({"name": "offset", "surface": {"name": "ball", "radius": 1.5}, "distance": -0.5}, _ball, 2e-5),
    ],
)  # fmt: skip
def test_distances_are_those_of_the_closed_form(
    surface: dict[str, Any], distance: Callable[[Tensor], Tensor], error: float
) -> None:
    medium = _medium(surface)
    low, high = medium.box
    points = low + torch.rand(20000, 3, generator=torch.Generator().manual_seed(0)) * (high - low)
    expected = distance(points.double() + torch.from_numpy(medium.origin)).float()
    found = medium.signed_distances(points)[0][:, 0]
    spacing = medium.grids[0].spacing.min()
    near = expected.abs() < 0.5 * spacing
    errors = (found - expected)[near].abs()
    assert errors.median() < error
    assert errors.max() < 0.3 * spacing  # at edges
    assert (found.sign() == expected.sign())[~near].all()
    assert (medium.origin == origin_of({"bodies": {"body": {"surface": surface, "ior": 1.5}}})).all()


def test_water_inside_a_wall_of_constant_thickness_is_an_offset_surface() -> None:
    """In concentric balls, n r sin(i) is constant along a ray (Bouguer's formula)."""
    ball = {"name": "ball", "radius": 1.0}
    bodies = {
        "glass": {"surface": ball, "ior": 1.5},
        "water": {"surface": {"name": "offset", "surface": ball, "distance": -0.1}, "ior": 1.33},
    }
    medium = make_bodies(bodies=bodies, resolution=48, cache=False)
    height = torch.linspace(0.05, 0.8, 9).double()
    origins = torch.stack([height, 0 * height, 0 * height + 3], -1)
    path = Snell()(make_rays(origins, [[0.0, 0.0, -1.0]] * 9, 0.5, 8.0), medium)
    turn = height.asin() - (height / 1.5).asin() + (height / 1.35).asin() - (height / (1.33 * 0.9)).asin()
    expected = torch.stack([-(2 * turn).sin(), 0 * turn, -(2 * turn).cos()], -1)
    assert angle(path.exit_directions, expected).max() < 0.02


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(
    ("surface", "message"),
    [
        ({"name": "bal"}, "no surface is called 'bal'; known: .*ball"),
        ({"name": "ball"}, "surface=ball needs radius"),
        ({"name": "ball", "radius": -1.0}, "surface=ball: radius=-1.0 is not allowed"),
        ({"name": "ball", "radius": 1.0, "centre": [0, 0]}, "surface.centre=.* give three numbers"),
        ({"name": "box", "sides": [1, 1, 0.1], "rounding": 0.2}, "at most half of the shortest side"),
        ({"name": "revolution", "profile": [[1, 0]]}, r"give points \[radius, height\]"),
        ({"name": "revolution", "profile": [[1, 0], [1, 1]], "axis": [0, 0, 0]}, "surface.axis=.* is no direction"),
        ({"name": "revolution", "profile": [[1, 0], [2, 0], [1, 0]]}, "encloses no volume"),
        ({"name": "revolution", "profile": [[0, 0], [1, 1], [1, 0], [0.1, 1]]}, "meets itself"),
        ({"name": "revolution", "profile": [[1, 0], [1, 1], [2, 1], [2, 0]]}, "begins and ends on the axis"),
        ({"name": "grid", "file": "positive.npz"}, "negative inside the body"),
        ({"name": "grid", "file": "empty.npz"}, "is no grid of distances"),
        ("ball", "needs one of mesh and surface"),
        ({"name": "offset", "surface": {"name": "ball", "radius": 1}, "distance": -1.5}, "lies inside the body body"),
        ({"name": "offset", "surface": {"name": "grid", "file": "torus.npz"}, "distance": 0.4}, "out of the grid"),
    ],
)
def test_wrong_surfaces_are_refused(surface: Any, message: str) -> None:
    np.savez("positive.npz", distances=np.ones((4, 4, 4)), box=np.array([[0, 0, 0], [1, 1, 1]]))
    np.savez("empty.npz", box=np.zeros((2, 3)))
    refused(message, _medium, surface)


def test_origin_of_a_mesh_without_a_file_is_refused() -> None:
    refused("surface=mesh needs file", origin_of, {"bodies": {"body": {"surface": {"name": "mesh"}, "ior": 1.5}}})
