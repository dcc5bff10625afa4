"""Cameras against hand-checked cases and an independent projection in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfro.core.cameras import Cameras, Window, central_window
from nerfro.testing import example_draws
from tests.cameras_at import cameras_at, random_poses


@pytest.fixture
def cameras() -> Cameras:
    """Five cameras of any orientation, with unequal focal lengths and the principal point off centre."""
    return cameras_at(random_poses(5), width=20, height=14, fx=15.0, fy=17.0, cx=9.2, cy=7.7)


def distance_to_ray(point: list[float], origin: torch.Tensor, direction: torch.Tensor) -> float:
    offset = torch.tensor(point) - origin
    return float(torch.linalg.norm(offset - (offset @ direction) * direction))


def test_ray_meets_the_point_that_projects_onto_its_pixel():
    # From (0, 0, 4) along -z: (0.4, 0.2, 0) lies 4 in front, so it is seen at 32 + 100 * 0.4 / 4 = 42 from the left
    # and 24 - 100 * 0.2 / 4 = 19 from the top: the corner of pixel (19, 42).
    pose = np.eye(4)[None, :3]
    pose[0, 2, 3] = 4
    camera = cameras_at(pose, 64, 48, 100.0)
    zero = torch.tensor([0])
    corner = camera.rays(zero, torch.tensor([19]), torch.tensor([42]), torch.zeros(1, 2))
    assert distance_to_ray([0.4, 0.2, 0.0], corner.origins[0], corner.directions[0]) < 1e-6
    centre = camera.rays(zero, torch.tensor([19]), torch.tensor([42]))
    assert distance_to_ray([0.42, 0.18, 0.0], centre.origins[0], centre.directions[0]) < 1e-6
    pixels, depth = camera.project(torch.tensor([[0.4, 0.2, 0.0], [0.0, 0.0, 7.0]]))
    torch.testing.assert_close(pixels[0, 0], torch.tensor([42.0, 19.0]))
    assert depth[0].tolist() == [4.0, -3.0], "the second point is behind the camera"


def test_points_on_rays_project_back_onto_their_pixels(cameras):
    generator = np.random.default_rng(1)
    view, row, column = generator.integers(0, [5, 14, 20], size=(200, 3)).T
    jitter = generator.random((200, 2)).astype(np.float32)
    rays = cameras.rays(*(torch.from_numpy(a) for a in (view, row, column, jitter)))
    points = (rays.origins + 3.7 * rays.directions).double().numpy()
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3] = cameras.camera_to_world.double()
    # OpenCV's projection matrix K [R | t], from the other end: world to camera, y down, z forward.
    world_to_camera = np.diag([1.0, -1, -1, 1]) @ np.linalg.inv(poses)
    camera_matrix = np.array([[15.0, 0, 9.2], [0, 17.0, 7.7], [0, 0, 1]])
    homogeneous = np.concatenate([points, np.ones((200, 1))], 1)
    image = np.einsum("ij,rjk,rk->ri", camera_matrix, world_to_camera[view, :3], homogeneous)
    assert (image[:, 2] > 0).all()
    np.testing.assert_allclose(image[:, 0] / image[:, 2], column + jitter[:, 0], atol=2e-5)
    np.testing.assert_allclose(image[:, 1] / image[:, 2], row + jitter[:, 1], atol=2e-5)


def test_disc_of_the_radius_has_the_variance_of_the_pixel():
    camera = cameras_at(np.eye(4)[None, :3], 1, 1, 8.0)
    radius = float(camera.image_rays(0).radii)
    # A disc of radius r has variance r^2 / 4 along an axis, a square of side w has w^2 / 12.
    assert radius**2 / 4 == pytest.approx((1 / 8) ** 2 / 12, rel=1e-6)


def test_cropped_cameras_see_the_same_rays_as_the_window_of_the_image(cameras):
    window = Window(top=3, left=5, height=6, width=9)
    full = cameras.image_rays(4).directions.reshape(14, 20, 3)
    cropped = cameras.crop(window)
    assert (cropped.width, cropped.height) == (9, 6)
    part = cropped.image_rays(4).directions.reshape(6, 9, 3)  # row by row
    torch.testing.assert_close(part, full[3:9, 5:14])
    images = torch.rand(5, 14, 20, 3)
    assert torch.equal(window.cut(images), images[:, 3:9, 5:14])


@pytest.mark.parametrize("distorted", [False, True])
def test_selected_cameras_are_those_of_the_views_in_order(cameras, distorted):
    scales = torch.arange(1.0, 6.0)
    lens = torch.zeros(5, 9)
    lens[:, 0] = 0.01 * scales
    cameras = replace(cameras, fx=15 * scales, cy=7 + scales, distortion=lens if distorted else None)
    for views in ([3], [4, 0, 2]):
        selected = cameras.select(views)
        assert len(selected) == len(views)
        for place, view in enumerate(views):
            ours, theirs = selected.image_rays(place), cameras.image_rays(view)
            assert torch.equal(ours.origins, theirs.origins)
            assert torch.equal(ours.directions, theirs.directions)


def test_resized_cameras_see_a_point_at_the_same_share_of_the_image(cameras):
    resized = cameras.resized(60, 7)
    assert (resized.width, resized.height) == (60, 7)
    points = torch.randn(8, 3)
    (before, depth), (after, same_depth) = cameras.project(points), resized.project(points)
    torch.testing.assert_close(after / torch.tensor([60, 7]), before / torch.tensor([20, 14]))
    assert torch.equal(depth, same_depth)


@pytest.mark.parametrize(
    ("size", "fraction", "window"),
    [((960, 1280), 0.5, (240, 320, 480, 640)), ((15, 11), 0.6, (3, 2, 8, 6)), ((15, 11), 1.0, (0, 0, 15, 11))],
)
def test_central_window_has_the_authors_size_and_is_centred(size, fraction, window):
    assert central_window(*size, fraction) == window


def test_tile_is_a_window_of_some_view(cameras):
    directions = torch.stack([cameras.image_rays(v).directions for v in range(5)]).reshape(5, 14, 20, 3)
    windows = directions.unfold(1, 6, 1).unfold(2, 6, 1).permute(0, 1, 2, 4, 5, 3)
    seen = set()
    for seed in range(40):
        tile = cameras.tile(6, example_draws(step=seed))
        found = ((windows - tile).abs().amax((-1, -2, -3)) < 1e-6).nonzero()
        assert len(found) == 1
        seen.add(tuple(found[0].tolist()))
    view, top, left = (set(place) for place in zip(*seen, strict=True))
    assert view == set(range(5))
    assert len(top) > 5
    assert len(left) > 8


def test_ray_generation_does_not_synchronize_the_device(cameras):
    # Tensors on the meta device have no values: reading one on the host raises.
    there = cameras.to("meta")
    index = torch.zeros(4, dtype=torch.long, device="meta")
    assert there.rays(index, index, index, torch.zeros(4, 2, device="meta")).directions.device.type == "meta"
    assert there.image_rays(1).directions.shape == (280, 3)
    assert there.tile(4, example_draws()).shape == (4, 4, 3)


def test_directions_keep_their_precision_in_mixed_precision(cameras):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = cameras.image_rays(0).directions
    assert torch.equal(mixed, cameras.image_rays(0).directions)


def test_directions_have_unit_length_despite_rounded_rotations(cameras):
    rounded = replace(cameras, camera_to_world=(cameras.camera_to_world * 1000).round() / 1000)
    assert torch.allclose(rounded.image_rays(0).directions.norm(dim=-1), torch.ones(280), atol=1e-6)
