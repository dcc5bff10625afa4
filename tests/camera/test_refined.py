"""Refined cameras: derivatives of rays, what is held, units, files; how far disturbed poses and gains come back."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfro.camera.refined import refined
from nerfro.camera.refined.refined import Similarity, motion_between, similarity
from nerfro.core.cameras import Cameras
from nerfro.core.lens import coefficients

NUM_VIEWS, SIZE = 8, 20


def cameras(distortion: tuple[float, ...] | None = None) -> Cameras:
    """Around a point, at different distances, in double precision."""
    generator = torch.Generator().manual_seed(1)
    back = normalize(torch.randn(NUM_VIEWS, 3, generator=generator, dtype=torch.float64), dim=-1)
    up = torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64).expand_as(back)
    right = normalize(torch.linalg.cross(up, back), dim=-1)
    distances = 3 + torch.rand(NUM_VIEWS, 1, generator=generator, dtype=torch.float64)
    centres = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64) + distances * back
    poses = torch.stack([right, torch.linalg.cross(back, right), back, centres], -1)
    focal, middle = torch.full((2, NUM_VIEWS), 24.0, dtype=torch.float64), torch.full((NUM_VIEWS,), 9.3).double()
    lens = None if distortion is None else torch.tensor([distortion] * NUM_VIEWS, dtype=torch.float64)
    return Cameras(poses, *focal, middle, middle, SIZE, SIZE, 0.5, 8.0, lens)


def part(given: Cameras, lens: bool = True, seed: int = 0) -> refined.RefinedCamera:
    """A camera part that has moved by about a pixel."""
    made = refined.RefinedCamera(lens=lens).double()
    made.begin(given)
    generator = torch.Generator().manual_seed(seed)
    made.move(*(torch.randn(shape, generator=generator, dtype=torch.float64) for shape in ((len(given), 6), (3,))))
    return made


def pixels(given: Cameras, num: int = 40) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    view, row, column = (torch.randint(most, (num,), generator=generator) for most in (len(given), SIZE, SIZE))
    return view, row, column


LENSES = [None, coefficients([0.05, -0.02], [0.002, -0.001])]


@pytest.mark.parametrize("distortion", LENSES)
def test_derivatives_match_central_differences(distortion: tuple[float, ...] | None) -> None:
    given = cameras(distortion)
    made, (view, row, column) = part(given), pixels(given)
    made.fix_gauge = False
    made.motion *= 0.01  # turns are composed to first order
    made.gauge_basis = made.gauge_basis[:0]
    rays = given.rays(view, row, column)
    by_origin, by_direction = torch.randn(2, len(view), 2, 3, dtype=torch.float64)
    found = made.slopes(rays, view, by_origin, by_direction)
    assert found.shape == (len(view), 2, 9)
    h = 1e-3
    for number in range(9):
        ends = []
        for sign in (h, -h):
            before = made.parameter_vector()
            step = sign * torch.eye(9, dtype=torch.float64)[number]
            made.move(step[:6].expand(NUM_VIEWS, 6), step[6:])
            moved = made(rays, view)
            by_all = (by_origin * moved.origins[:, None]).sum(-1) + (by_direction * moved.directions[:, None]).sum(-1)
            ends.append(by_all)
            made.restore(before, torch.ones(NUM_VIEWS, dtype=torch.bool), lens=True)
        expected = (ends[0] - ends[1]) / (2 * h)
        torch.testing.assert_close(found[..., number], expected, rtol=1e-2, atol=1e-3 * float(expected.abs().max()))


def test_common_motion_of_all_cameras_is_removed() -> None:
    given = cameras()
    made, small = part(given), 1e-4
    poses = given.camera_to_world
    turn = refined.rotation_matrices(small * torch.tensor([[0.3, -0.7, 0.5]], dtype=torch.float64))[0]
    world = Similarity(torch.tensor(1 + small).double(), turn, small * torch.tensor([1.0, 2.0, -1.0]).double())
    shared = world.apply(poses)
    turns, shifts = poses[..., :3].mT @ shared[..., :3], poses[..., :3].mT @ (shared[..., 3:] - poses[..., 3:])
    vector = torch.stack([turns[:, 2, 1], turns[:, 0, 2], turns[:, 1, 0]], -1)
    before = made.moved()
    with torch.no_grad():
        made.motion += torch.cat([vector, shifts[..., 0]], -1) / made.units
    free = refined.RefinedCamera(fix_gauge=False).double()
    free.begin(given)
    free.motion = torch.cat([vector, shifts[..., 0]], -1) / free.units
    torch.testing.assert_close(free.aligned(given).camera_to_world, shared, rtol=0, atol=1e-6)  # to first order
    turned, shifted = motion_between(before, made.moved())
    moved = motion_between(poses, shared)
    assert turned.max().item() < 1e-3 * moved[0].max().item()
    assert float(shifted.max()) < 1e-3 * float(moved[1].max())


def test_each_parameter_unit_moves_points_by_one_pixel() -> None:
    given = cameras()
    distances, h = refined.object_distances(given), 1e-5
    axis = (torch.arange(90) + 0.5).double() * SIZE / 90
    motions = refined.pixel_motions(given, distances)
    for view in range(len(given)):
        one = given.select([view])
        u, v = (place.flatten() for place in torch.meshgrid(axis, axis, indexing="xy"))
        local = torch.stack([(u - one.cx) / one.fx, (one.cy - v) / one.fy, -torch.ones_like(u)], -1)
        points = distances[view] * local @ one.camera_to_world[0, :, :3].T + one.camera_to_world[0, :, 3]
        axes = one.camera_to_world[..., :3]
        for k in range(6):
            turn, shift = torch.zeros(2, 1, 3, dtype=torch.float64)
            (turn if k < 3 else shift)[0, k % 3] = h
            pose = torch.cat(
                [axes @ refined.rotation_matrices(turn), one.camera_to_world[..., 3:] + axes @ shift[..., None]], -1
            )
            seen, _ = replace(one, camera_to_world=pose).project(points)
            moved = (seen[0] - torch.stack([u, v], -1)).square().sum(-1).mean().sqrt() / h
            assert float(motions[view, k]) == pytest.approx(float(moved), rel=0.02)
        seen, _ = replace(one, fx=one.fx * (1 + h), fy=one.fy * (1 + h)).project(points)
        moved = (seen[0] - torch.stack([u, v], -1)).square().sum(-1).mean().sqrt() / h
        assert float(motions[view, 6]) == pytest.approx(float(moved), rel=0.02)


def test_similarity_is_recovered() -> None:
    poses = cameras().camera_to_world
    turn = refined.rotation_matrices(torch.tensor([[0.5, -1.0, 2.0]], dtype=torch.float64))[0]
    made = Similarity(torch.tensor(1.7).double(), turn, torch.tensor([3.0, -1.0, 0.5]).double())
    for some in (poses, poses[:2], poses[:1]):
        found = similarity(some, made.apply(some), *torch.rand(2, len(some), dtype=torch.float64) + 0.5)
        torch.testing.assert_close(found.rotation, made.rotation)
        torch.testing.assert_close(found.apply(some), made.apply(some))
        if len(some) > 1:
            torch.testing.assert_close(found.scale, made.scale)


@pytest.mark.parametrize("scale", [2.0**-22, 1.0, 2.0**21])
def test_gauge_freedom_has_seven_dimensions_in_any_world_unit(scale: float) -> None:
    given = cameras()
    poses = torch.cat([given.camera_to_world[..., :3], scale * given.camera_to_world[..., 3:]], -1)
    given = replace(given, camera_to_world=poses, near=scale * given.near, far=scale * given.far)
    weights = refined.even_weights(refined.pixel_motions(given, refined.object_distances(given)))
    assert len(refined.gauge_basis(poses, weights)) == 7
