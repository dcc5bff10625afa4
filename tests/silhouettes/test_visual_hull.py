"""From silhouettes to a surface: outlines, carving, the fit, and reports of inconsistent silhouettes and meshes."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from nerfro.core.errors import NerfroError
from nerfro.core.paths import ASSETS_DIR
from nerfro.data.base import Views
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.media.body_settings import make_bodies
from nerfro.silhouettes import surface
from nerfro.silhouettes.agreement import overlap, require_consistent_poses
from nerfro.silhouettes.mesh_match import require_match
from nerfro.silhouettes.moving_mesh import MovingMesh
from nerfro.silhouettes.rims import Rims, by_pixel_sides, find_rims, outlines_of
from nerfro.silhouettes.silhouette_fit import fit_surface
from nerfro.silhouettes.silhouettes import is_antialiased, mesh_silhouettes, outline_distance
from nerfro.silhouettes.surface import make_mesh
from nerfro.silhouettes.visual_hull import (
    Silhouettes,
    carve_grid,
    extract_surface,
    find_box,
    reaches_border,
    remove_strays,
)
from tests.cameras_at import cameras_at, poses_towards_origin
from tests.conftest import refused
from tests.exact_silhouettes import cameras_around, hull, odd_shape, photographed, photographed_softly, volume


@pytest.fixture(scope="module", name="odd_shape")
def _odd_shape() -> trimesh.Trimesh:
    return odd_shape()


def test_outline_of_a_binary_mask_is_found_between_the_pixels() -> None:
    column, row = np.meshgrid(np.arange(32) + 0.5, np.arange(32) + 0.5)
    errors = []
    for angle in np.linspace(0.1, 6, 23):
        exact = np.cos(angle) * (column - 16.3) + np.sin(angle) * (row - 15.8)
        found = outline_distance((exact > 0).astype(np.float32))
        assert ((found > 0) == (exact > 0)).all()
        near = (np.abs(exact) < 1) & (np.hypot(column - 16, row - 16) < 12)
        errors.append((found - exact)[near])
    # A mask that is only counted pixel by pixel is off by 0.29 (uniform between two of them).
    assert np.std(np.concatenate(errors)) < 0.18


def test_outline_of_a_coverage_mask_does_not_shrink_at_curves() -> None:
    """Without the correction it is drawn in by variance / 2r, 0.108 pixels here."""
    place = (np.arange(32 * 16) + 0.5) / 16
    fine = 5 - np.hypot(place - 16.2, place[:, None] - 15.7)
    mask = (fine > 0).reshape(32, 16, 32, 16).mean((1, 3))
    exact = 5 - np.hypot(np.arange(32) - 15.7, np.arange(32)[:, None] - 15.2)
    near = np.abs(exact) < 0.5
    error = (outline_distance(mask) - exact)[near]
    assert abs(error.mean()) < 0.03
    assert error.std() < 0.03


def test_silhouette_is_complete_where_a_lens_bends_long_edges() -> None:
    """Every ray of a picture is tested, beside those near the projected vertices."""
    made = trimesh.creation.box((1.6, 1.6, 1.6))
    box = TriangleMesh(np.asarray(made.vertices), np.asarray(made.faces))
    poses = poses_towards_origin(np.array([[0.0, 0, 1]]), 2.6, (0.0, 1.0, 0.0))
    lens = torch.zeros(1, 9)
    lens[0, 0] = -0.2
    cameras = replace(cameras_at(poses, 512, 512, 512.0, near=1.0, far=9.0), distortion=lens)
    rays = cameras.image_rays(0)
    hits = MeshIntersector(box.triangles).first_hits(rays.origins, rays.directions) >= 0
    assert torch.equal(mesh_silhouettes(box, cameras, 1).flatten(), hits)


def test_hull_of_a_ball_is_accurate_below_a_voxel() -> None:
    silhouettes = photographed(trimesh.creation.icosphere(4, 0.7), cameras_around(30, 64))
    mesh = hull(silhouettes, 32)
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert mesh.is_closed
    # A pixel is 0.045 wide here and a voxel 0.05.
    assert abs(radii.mean() - 0.7) < 0.01
    assert radii.std() < 0.015
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.05)


def test_points_behind_a_camera_or_beyond_a_cut_frame_are_unknown() -> None:
    cameras = cameras_around(1, 16)
    back = cameras.camera_to_world[0, :, 2]
    masks = torch.zeros(1, 16, 16)
    masks[:, 4:12, 4:12] = 1
    points = torch.stack([8 * back, 0 * back, 3 * cameras.camera_to_world[0, :, 0]])  # behind, centre, beside
    whole = Silhouettes.of(cameras, masks).depth_inside(0, points)[0]
    assert whole[0] == torch.inf
    assert whole[1] > 2
    assert whole[2] < -5
    masks[:, 4:12, 4:] = 1
    assert Silhouettes.of(cameras, masks).depth_inside(0, points)[0][2] == torch.inf


def test_points_are_outside_unless_enough_views_contain_them() -> None:
    cameras, generator = cameras_around(4, 16), torch.Generator().manual_seed(0)
    masks = torch.zeros(4, 16, 16)
    masks[:, 4:12, 4:] = 1  # cut by the image border
    silhouettes = Silhouettes.of(cameras, masks)
    points = 3 * (2 * torch.rand(2000, 3, generator=generator) - 1)
    num_seen = torch.stack([silhouettes.depth_inside(view, points)[0] < torch.inf for view in range(4)]).sum(0)
    for wrong_masks in (0, 2):
        distances = silhouettes.carve(points, wrong_masks)
        assert distances.isfinite().all()
        assert (distances[num_seen < max(2, wrong_masks + 1)] > 0).all()
        assert (distances < 0).any()


def test_wrong_masks_are_tolerated_on_request(odd_shape: trimesh.Trimesh) -> None:
    right = photographed(odd_shape, cameras_around(20, 48))
    masks = right.masks.clone()
    masks[3] = masks[3].roll(20, 1)
    wrong = Silhouettes.of(right.cameras, masks)
    box, expected = find_box(right), volume(hull(right, 40))
    assert (carve_grid(wrong, box, 40)[0] < 0).sum() < 0.3 * (carve_grid(right, box, 40)[0] < 0).sum()
    assert volume(hull(wrong, 40, wrong_masks=1)) == pytest.approx(expected, rel=0.25)


def test_too_small_box_grows(odd_shape: trimesh.Trimesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wrong masks shift the place where all seem to meet."""
    silhouettes = photographed(odd_shape, cameras_around(12, 48))
    whole = make_mesh(silhouettes, None, 32, 0, None, 0.0)
    small = whole.bounds.mean(0) + 0.4 * np.ptp(whole.bounds, axis=0).max() * np.array([[-1.0], [1.0]])
    monkeypatch.setattr(surface, "find_box", lambda *given: small)
    assert make_mesh(silhouettes, None, 32, 0, None, 0.0).bounds == pytest.approx(whole.bounds, abs=0.05)


def test_small_components_are_kept_on_request() -> None:
    """The small ball has 1 % of the volume, and the box is that of all components."""
    balls = [trimesh.creation.icosphere(2, 0.45).apply_translation((-0.2, 0, 0)), trimesh.creation.icosphere(2, 0.11)]
    balls[1].apply_translation((0.75, 0, 0))
    silhouettes = photographed(trimesh.util.concatenate(balls), cameras_around(12, 64))
    assert make_mesh(silhouettes, None, 48, 0, 2, 0.0).bounds[1, 0] == pytest.approx(0.86, abs=0.05)
    assert make_mesh(silhouettes, None, 48, 0, None, 0.0).bounds[1, 0] == pytest.approx(0.25, abs=0.05)


def test_empty_hull_is_named() -> None:
    cameras = cameras_around(4, 16)
    parts = [
        photographed(trimesh.creation.icosphere(2, 0.3).apply_translation((x, 0, 0)), cameras) for x in (-0.8, 0.8)
    ]
    masks = parts[0].masks.clone()
    masks[::2] = parts[1].masks[::2]
    refused("the visual hull is empty", make_mesh, Silhouettes.of(cameras, masks), None, 16, 0, None, 0.0)


def test_stray_voxels_are_removed_and_voids_are_filled() -> None:
    x, y, z = np.meshgrid(*[np.arange(20.0)] * 3, indexing="ij")

    def ball(cx: float, radius: float) -> np.ndarray:
        return np.sqrt((x - cx) ** 2 + (y - 8) ** 2 + (z - 8) ** 2) - radius

    shell = np.maximum(ball(6, 5), -ball(6, 2))
    distances = np.minimum(np.minimum(shell, ball(14.5, 2)), np.where((x == 18) & (y == 17) & (z == 1), -0.1, 9))
    assert remove_strays(distances.copy(), keep=1) == (3, 1)
    assert remove_strays(distances) == (3, 2)  # one voxel is a stray, the small ball is not
    assert distances[6, 8, 8] < 0
    assert distances[18, 17, 1] > 0
    assert len(trimesh.Trimesh(*_arrays(extract_surface(distances, np.zeros(3), 1.0))).split()) == 2


def _arrays(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.vertices, mesh.faces


def test_body_is_closed_at_the_box() -> None:
    distances = np.full((6, 6, 6), 0.5)
    distances[3:, 2:4, 2:4] = -0.5
    assert reaches_border(distances)
    assert not reaches_border(np.pad(distances, 1, constant_values=0.5))
    mesh = extract_surface(distances, np.array([1.0, 2, 3]), 0.5)
    assert mesh.is_closed
    assert volume(mesh) > 0
    assert mesh.bounds[0] == pytest.approx([2.25, 2.75, 3.75])


@pytest.mark.slow
def test_fit_is_smooth_despite_uneven_triangles_of_marching_cubes() -> None:
    silhouettes = photographed_softly(trimesh.creation.icosphere(5, 0.7), cameras_around(24, 48))
    fitted = fit_surface(hull(silhouettes, 32), silhouettes)
    normals = np.cross(*np.diff(fitted.triangles, axis=1).swapaxes(0, 1))
    outwards = fitted.triangles.mean(1)
    cosine = (normals * outwards).sum(1) / (np.linalg.norm(normals, axis=1) * np.linalg.norm(outwards, axis=1))
    assert np.degrees(np.arccos(cosine.clip(max=1))).mean() < 0.8  # 2.6 with vertices as marching cubes leave them
    assert np.linalg.norm(fitted.vertices, axis=1) == pytest.approx(0.7, rel=0.005)


@pytest.mark.slow
def test_fit_to_few_views_is_closer_to_the_body_than_the_visual_hull() -> None:
    embedded = load_mesh(ASSETS_DIR / "torus" / "mesh.ply")
    body = trimesh.Trimesh(embedded.vertices * 1.4 / np.ptp(embedded.bounds, axis=0).max(), embedded.faces)
    silhouettes = photographed(body, cameras_around(12, 64))
    carved = hull(silhouettes, 32)
    nearest = cKDTree(body.sample(300_000, seed=0))
    hull_error, fit_error = (
        np.sqrt(np.mean(nearest.query(each.vertices)[0] ** 2)) for each in (carved, fit_surface(carved, silhouettes))
    )
    assert fit_error < 0.6 * hull_error  # 0.9 if the weight of steady curvature follows the validation error


@pytest.mark.slow
def test_fit_is_invariant_to_the_unit_of_length() -> None:
    silhouettes = photographed(trimesh.creation.box((1.2, 0.9, 0.7)), cameras_around(12, 32))
    carved = hull(silhouettes, 16)
    poses = silhouettes.cameras.camera_to_world * torch.tensor([1.0, 1, 1, 8])
    larger = replace(silhouettes, cameras=replace(silhouettes.cameras, camera_to_world=poses))
    scaled = fit_surface(TriangleMesh(8 * carved.vertices, carved.faces), larger)
    np.testing.assert_allclose(scaled.vertices / 8, fit_surface(carved, silhouettes).vertices, atol=2e-3)


def test_hull_projects_onto_its_masks(odd_shape: trimesh.Trimesh) -> None:
    silhouettes = photographed(odd_shape, cameras_around(16, 64))
    require_consistent_poses(silhouettes, [f"r_{view}" for view in range(16)], wrong_masks=0)
    assert overlap(hull(silhouettes, 48), silhouettes, 64).mean() > 0.93


MISREAD = {
    "y and z axes flipped": lambda pose: pose * torch.tensor([1.0, -1, -1, 1]),
    "the matrices inverted": lambda pose: torch.cat([pose[:, :, :3].mT, -pose[:, :, :3].mT @ pose[:, :, 3:]], -1),
    "with y flipped": lambda pose: pose * torch.tensor([1.0, -1, 1, 1]),
    "with x flipped": lambda pose: pose * torch.tensor([-1.0, 1, 1, 1]),
    "LLFF's axes": lambda pose: torch.cat([-pose[:, :, 1:2], pose[:, :, :1], pose[:, :, 2:]], -1),
}


@pytest.mark.parametrize("convention", MISREAD)
def test_wrong_poses_are_reported(odd_shape: trimesh.Trimesh, convention: str) -> None:
    silhouettes = photographed(odd_shape, cameras_around(16, 32))
    poses = MISREAD[convention](silhouettes.cameras.camera_to_world)
    misread = replace(silhouettes, cameras=replace(silhouettes.cameras, camera_to_world=poses))
    with pytest.raises(NerfroError, match=rf"poses use another convention: .*{convention}"):
        require_consistent_poses(misread, [str(view) for view in range(16)], wrong_masks=0)


def test_shuffled_masks_are_refused(odd_shape: trimesh.Trimesh) -> None:
    silhouettes = photographed(odd_shape, cameras_around(16, 32))
    shuffled = Silhouettes.of(silhouettes.cameras, silhouettes.masks.roll(5, 0))
    with pytest.raises(NerfroError, match="none of the known pose conventions explains the difference"):
        require_consistent_poses(shuffled, [str(view) for view in range(16)], wrong_masks=0)


@pytest.mark.parametrize("scale", [2.0**-10, 2.0**10])
def test_hull_of_a_cut_object_is_independent_of_the_world_unit(scale: float) -> None:
    hulls = []
    for unit in (1.0, scale):
        made = trimesh.creation.box((unit, 0.8 * unit, 6 * unit))
        cameras = cameras_around(6, 32, distance=4 * unit)
        silhouettes = photographed(made, cameras)
        assert silhouettes.cut.any()
        box = unit * np.array([[-1.2] * 3, [1.2] * 3])
        distances, spacing = carve_grid(silhouettes, box, 24)
        hulls.append(extract_surface(distances, box[0], spacing).vertices / unit)
    np.testing.assert_array_equal(*hulls)


RADIUS, MIDDLE = 0.7, np.array([0.11, 0.07, -0.05])


def ball(radius: float = RADIUS) -> trimesh.Trimesh:
    """Beside the point that the cameras look at: each view sees another disc."""
    return trimesh.creation.icosphere(5, radius).apply_translation(MIDDLE)


def seen(radius: float, silhouettes: Silhouettes) -> tuple[Rims, Rims]:
    """Rims of a ball of another radius, as read off the outlines, and by the sides of pixels."""
    made = ball(radius)
    surface = MovingMesh(np.asarray(made.faces)).geometry(np.asarray(made.vertices))
    rims = find_rims(surface, silhouettes, outlines_of(silhouettes))
    return rims, by_pixel_sides(rims, silhouettes, 0.16)


def pixel(size: int) -> float:
    """Width of a pixel at the rims of a body in the middle, world units."""
    return 3.94 / 1.4 / size


def mean(rims: Rims) -> float:
    """Misfit, pixels."""
    return float(np.average(rims.misfit / rims.width, weights=rims.weight))


@pytest.fixture(scope="module")
def silhouettes() -> Silhouettes:
    return photographed(ball(), cameras_around(20, 96))


def test_correct_surface_is_unchanged(silhouettes: Silhouettes) -> None:
    """The outlines that are read off the masks want single rims to move by a tenth of a pixel."""
    read, sides = seen(RADIUS, silhouettes)
    moves = [np.sqrt(np.average((rims.misfit / rims.width) ** 2, weights=rims.weight)) for rims in (read, sides)]
    assert abs(mean(sides)) < 0.02
    assert moves[1] < 0.5 * moves[0]


@pytest.mark.parametrize("off", [-0.3, 0.3])
def test_displaced_surface_moves_to_the_outlines(silhouettes: Silhouettes, off: float) -> None:
    """In a few steps."""
    width = pixel(silhouettes.cameras.width)
    radius = RADIUS + off * width
    for _ in range(6):
        radius += width * mean(seen(radius, silhouettes)[1])
    assert abs(radius - RADIUS) / width < 0.03


@pytest.mark.slow
def test_fitted_surface_has_the_size_of_the_body() -> None:
    """It is 0.09 pixels too small if the sides of pixels are not looked at."""
    size, axes = 48, np.array([0.8, 0.6, 0.45])
    body = trimesh.creation.icosphere(5)
    body.vertices = axes * body.vertices + MIDDLE
    silhouettes = photographed(body, cameras_around(20, size))
    fitted = fit_surface(hull(silhouettes, 24), silhouettes)
    beyond = axes.mean() * (np.linalg.norm((fitted.vertices - MIDDLE) / axes, axis=1) - 1)
    assert abs(beyond.mean()) < 0.05 * pixel(size)


def test_binary_masks_are_distinguished_from_coverage_masks(silhouettes: Silhouettes) -> None:
    soft = photographed_softly(ball(), silhouettes.cameras, 4)
    nearly = Silhouettes.of(silhouettes.cameras, (silhouettes.masks + 0.01).clamp(max=1))  # as JPEG leaves them
    empty = torch.zeros(1, 8, 8)
    assert is_antialiased(soft.masks.numpy(), soft.distances.numpy())
    for masks in (silhouettes, nearly):
        assert not is_antialiased(masks.masks.numpy(), masks.distances.numpy())
    assert not is_antialiased(empty.numpy(), Silhouettes.of(silhouettes.cameras.select([0]), empty).distances.numpy())


OBJECT = trimesh.util.concatenate(
    [trimesh.creation.icosphere(2, 0.3), trimesh.creation.box((1, 0.2, 0.2)).apply_translation((0.9, 0, 0.1))]
)
SWAPPED = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.fixture(scope="module")
def views() -> Views:
    """Views of the object from all sides, with its silhouettes as masks."""
    photographs = photographed(OBJECT, cameras_around(9, 32))
    return Views(photographs.cameras, torch.zeros(9, 32, 32, 3), photographs.masks, [str(i) for i in range(9)])


@pytest.mark.parametrize(
    ("matrix", "shift", "message"),
    [
        (np.eye(3), (0, 0, 0), None),
        (0.01 * np.eye(3), (0, 0, 0), "only to 0%; the mesh scaled by 100 agrees"),
        (100 * np.eye(3), (0, 0, 0), "all cameras lie inside the object, which is .*; the mesh scaled by 0.01 agrees"),
        (SWAPPED, (0, 0, 0), r"the mesh with \(x, y, z\) replaced by \(x, z, -y\) agrees"),
        (np.eye(3), (50, 20, 0), r"the mesh moved by \[-(50|49\.9).*, -(20|19\.9).*, -?0.*\] agrees"),
    ],
    ids=["right", "small", "large", "axes", "place"],
)
def test_unit_axes_and_position_of_a_mesh_are_compared_with_the_masks(
    matrix: np.ndarray, shift: tuple[int, ...], message: str | None, views: Views, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    changed = trimesh.Trimesh(OBJECT.vertices @ matrix.T + shift, OBJECT.faces, process=False)
    changed.export(tmp_path / "mesh.ply")
    medium = make_bodies(str(tmp_path / "mesh.ply"), resolution=24, cache=False)
    try:
        require_match(medium, views)
        said = capsys.readouterr().out
    except NerfroError as error:
        said = str(error)
    assert said == "" if message is None else re.search(message, said), said
