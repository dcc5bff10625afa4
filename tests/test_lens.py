"""Distortion against hand-worked numbers, finite differences and its own inverse; cameras that have it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfro.cameras import Cameras
from nerfro.lens import coefficients, distort, opencv_coefficients, undistort
from tests.cameras_at import cameras_at, random_poses

LENSES = {
    "barrel": coefficients([-0.18, 0.03]),
    "tangential": coefficients([0.05], [0.01, -0.006]),
    "nerfstudio": coefficients([-0.1, 0.02, -0.003, 0.0004], [0.001, 0.002]),
    "rational": opencv_coefficients([0.4, 0.05, 0.001, -0.002, 0.002, 0.6, 0.1, 0.01]),
}


@pytest.fixture(params=LENSES, ids=str)
def lens(request) -> torch.Tensor:
    return torch.tensor(LENSES[request.param], dtype=torch.float64)


@pytest.fixture
def points() -> torch.Tensor:
    axis = torch.linspace(-0.7, 0.7, 9, dtype=torch.float64)
    return torch.cartesian_prod(axis, axis)


def test_distortion_matches_a_manual_computation():
    point = torch.tensor([[0.5, -0.2]], dtype=torch.float64)  # r^2 = 0.29, r^4 = 0.0841
    one = lambda *a, **b: distort(point, torch.tensor([coefficients(*a, **b)], dtype=torch.float64))[0][0].tolist()  # noqa: E731
    assert one([0.1, 0.01]) == pytest.approx([0.5 * 1.029841, -0.2 * 1.029841])
    # 2 p1 x y + p2 (r^2 + 2 x^2) and p1 (r^2 + 2 y^2) + 2 p2 x y
    assert one([], [0.1, 0.0]) == pytest.approx([0.5 - 0.02, -0.2 + 0.037])
    assert one([], [0.0, 0.1]) == pytest.approx([0.5 + 0.079, -0.2 - 0.02])
    assert one([], [], [0.1]) == pytest.approx([0.5 / 1.029, -0.2 / 1.029])


def test_opencv_order_and_an_ideal_lens():
    assert opencv_coefficients([1, 2, 3, 4, 5, 6, 7, 8]) == (1, 2, 5, 0, 3, 4, 6, 7, 8)
    assert opencv_coefficients([1, 2, 3, 4]) == (1, 2, 0, 0, 3, 4, 0, 0, 0)
    assert coefficients() is None
    assert opencv_coefficients([0.0] * 5) is None


def test_derivatives_are_those_of_finite_differences(lens, points):
    many = lens.expand(len(points), 9)
    _, derivatives = distort(points, many)
    for axis, found in ((0, derivatives[:, :2]), (1, derivatives[:, 1:])):
        step = torch.zeros(2, dtype=torch.float64)
        step[axis] = 1e-6
        expected = (distort(points + step, many)[0] - distort(points - step, many)[0]) / 2e-6
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8)


def test_undistorting_inverts_distorting(lens, points):
    many = lens.expand(len(points), 9)
    distorted, derivatives = distort(points, many)
    ideal, area = undistort(distorted, many)
    torch.testing.assert_close(ideal, points, rtol=0, atol=1e-12)
    xx, xy, yy = derivatives.unbind(-1)
    torch.testing.assert_close(area, 1 / (xx * yy - xy**2))


@pytest.fixture
def cameras() -> Cameras:
    """Three cameras of any orientation, one of them without distortion."""
    ideal = (0.0,) * 9
    distortion = torch.tensor([LENSES["barrel"], ideal, LENSES["rational"]])
    return replace(cameras_at(random_poses(3), 48, 36, 40.0, 42.0, 24.6, 17.1), distortion=distortion)


def test_radii_follow_the_area_of_the_pixel(cameras):
    square = replace(cameras, fy=cameras.fx)
    rays = square.image_rays(0)
    forward = -square.camera_to_world[0, :, 2].double()
    directions = rays.directions.double()
    plane = (directions / (directions @ forward)[:, None]).reshape(36, 48, 3)
    across, down = plane[1:-1, 2:] - plane[1:-1, :-2], plane[2:, 1:-1] - plane[:-2, 1:-1]
    area = torch.linalg.cross(across, down).norm(dim=-1) / 4
    expected = 2 / 12**0.5 * area.sqrt() / plane[1:-1, 1:-1].norm(dim=-1)
    torch.testing.assert_close(rays.radii.double().reshape(36, 48)[1:-1, 1:-1], expected, rtol=2e-3, atol=0)


@pytest.mark.parametrize("k1", [-0.1, -0.3, 0.2])
def test_points_outside_the_field_of_view_project_outside_the_image(k1):
    camera = cameras_at(np.eye(4)[None, :3], 400, 400, 400.0)
    camera = replace(camera, distortion=torch.tensor([coefficients([k1, -0.05])]))
    corners = camera.rays(*(torch.tensor(x) for x in ([0] * 4, [0, 0, 399, 399], [0, 399, 0, 399])))
    field_of_view = torch.rad2deg(torch.acos(-corners.directions[:, 2])).max()
    angle, turn = torch.cartesian_prod(torch.arange(1, 89.5, 0.5), torch.arange(0.0, 360, 15)).deg2rad().unbind(-1)
    points = torch.stack([angle.tan() * turn.cos(), angle.tan() * turn.sin(), -torch.ones_like(angle)], -1)
    pixels, depth = camera.project(points)
    inside = ((pixels[0] >= 0) & (pixels[0] <= 400)).all(-1) & (depth[0] > 0)
    assert inside.any()
    assert torch.rad2deg(angle[inside]).max() <= field_of_view + 0.5
