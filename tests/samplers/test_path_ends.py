"""A bent path ends after its last exit from the object, for any `far`; straight paths."""

import functools
from pathlib import Path as FilePath

import pytest
import torch
import trimesh
from torch import Tensor

from nerfro.core.types import Path, Rays
from nerfro.geometry.interpolation import intersect_box
from nerfro.media.base import Medium
from nerfro.media.body_settings import make_bodies
from nerfro.paper.eikonal import Eikonal
from nerfro.samplers.base import PathSampler, Straight
from tests.closed_forms import Ball, RoundedBox, random_rays
from tests.reference_tracer import Snell

_rays = functools.partial(random_rays, 200, 1.2, 4)
# From the camera at distance 3 the near face of the cube is reached, its far one is not.
SHORT, LONG = 3.2, 60.0


def _medium(folder: FilePath, kind: str) -> Medium:
    if kind == "analytic":
        return RoundedBox(0.7, 0.1, 1.5)
    trimesh.creation.box(extents=[1.4, 1.4, 1.4]).export(folder / "cube.ply")
    return make_bodies(str(folder / "cube.ply"), 1.5, resolution=48, cache=False)


CASES = [
    (Snell("sdf"), "grid"), (Snell("mesh"), "grid"), (Snell(), "analytic"),
    (Eikonal(), "grid"), (Eikonal(), "analytic"),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("sampler", "kind"), CASES)
def test_far_does_not_cut_a_path_inside_the_object(tmp_path: FilePath, sampler: PathSampler, kind: str) -> None:
    medium = _medium(tmp_path, kind)
    short, long = sampler(_rays(far=SHORT), medium), sampler(_rays(far=LONG), medium)
    bent = long.refracted
    assert bent.sum() > 50
    torch.testing.assert_close(short.exit_directions, long.exit_directions)
    assert (short.far >= SHORT).all()
    torch.testing.assert_close(short.far[~bent], torch.full_like(short.far[~bent], SHORT))
    assert _outside(short, medium)[bent].all()
    # The end lies on the line along which the longer path goes on.
    at_short_end, _ = long.at(short.far[:, None])
    torch.testing.assert_close(at_short_end[:, 0], short.end_positions, atol=2e-5, rtol=0)


@pytest.mark.parametrize(("sampler", "kind"), [(Snell("sdf", 2), "grid"), (Snell("mesh", 2), "grid")])
def test_rays_at_the_limit_of_events_end_outside(tmp_path: FilePath, sampler: Snell, kind: str) -> None:
    medium = _medium(tmp_path, kind)
    trace = sampler.trace(_rays(far=SHORT), medium)
    assert trace.exceeded.any()
    assert _outside(trace.path, medium)[trace.path.refracted].all()


def _outside(path: Path, medium: Medium) -> Tensor:
    """Whether paths end where nothing of the medium's box lies ahead."""
    _, leave = intersect_box(medium.box, path.end_positions, path.exit_directions)
    return leave <= 0


def test_path_is_the_line_from_near_to_far_in_any_medium() -> None:
    origins = torch.randn(5, 3)
    directions = torch.nn.functional.normalize(torch.randn(5, 3), dim=-1)
    near, far = torch.rand(5), 4 + torch.rand(5)
    path = Straight()(Rays(origins, directions, torch.ones(5), near, far), Ball())
    torch.testing.assert_close(path.near, near)
    torch.testing.assert_close(path.far, far)
    s = torch.linspace(0, 1, 7) * (far - near)[:, None] + near[:, None]
    positions, along = path.at(s)
    torch.testing.assert_close(positions, origins[:, None] + s[..., None] * directions[:, None])
    torch.testing.assert_close(along, directions[:, None].expand(-1, 7, -1))
    torch.testing.assert_close(path.exit_directions, directions)
    assert not path.refracted.any()
