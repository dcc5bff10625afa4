"""Distortion against hand-worked numbers, finite differences and its own inverse; cameras that have it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfro.core.cameras import Cameras
from nerfro.core.lens import coefficients, distort, opencv_coefficients, undistort
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


@pytest.mark.parametrize(
    ("lens", "focal"),
    [
        (coefficients([-0.25]), 40.0),
        (coefficients([0.5, -0.2]), 25.0),
        (coefficients([], [], [-0.5]), 40.0),  # the radius is infinite at 55 degrees
    ],
    ids=["barrel", "pincushion", "rational"],
)
def test_directions_beyond_the_field_of_view_project_outside_the_image(lens, focal):
    camera = replace(cameras_at(np.eye(4)[None, :3], 48, 36, focal), distortion=torch.tensor([lens]))
    corners = camera.rays(torch.zeros(4, dtype=torch.long), torch.tensor([0, 0, 36, 36]), torch.tensor([0, 48] * 2),
                          torch.zeros(2))  # fmt: skip
    widest = torch.acos(-corners.directions[:, 2].min().double())
    angle = torch.linspace(float(widest) + 0.01, np.radians(89.9), 200)
    azimuth = torch.linspace(0, 2 * np.pi, 60)
    sine, cosine = torch.sin(angle)[:, None], -torch.cos(angle)[:, None].expand(-1, 60)
    points = torch.stack([sine * torch.cos(azimuth), sine * torch.sin(azimuth), cosine], -1).reshape(-1, 3)
    pixels, depth = camera.project(points)
    assert (depth > 0).all()
    assert not ((pixels >= 0) & (pixels <= torch.tensor([48, 36]))).all(-1).any()
    torch.testing.assert_close(
        camera.project(corners.directions)[0][0], torch.tensor([[0, 0], [48, 0], [0, 36], [48, 36.0]])
    )
