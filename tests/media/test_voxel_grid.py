"""The paper's medium: smoothing, gradient, look-up, files and refusals."""

from pathlib import Path

import pytest
import torch
import trimesh

from nerfro.core.errors import NerfroError
from nerfro.paper.voxel_grid import VoxelGrid, gradient
from tests.closed_forms import grid_points
from tests.conftest import refused

BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])


@pytest.fixture
def sphere(tmp_path: Path) -> str:
    trimesh.creation.icosphere(3, 0.8).export(tmp_path / "sphere.ply")
    return str(tmp_path / "sphere.ply")


def _ball_occupancy(size: int) -> torch.Tensor:
    radius = grid_points(1.5, size).norm(dim=-1)
    return (radius < 0.8).float()


def test_gradient_is_central_inside_and_half_at_the_border() -> None:
    x = torch.arange(6.0)
    values = (3 * x)[:, None, None].expand(6, 4, 4)
    result = gradient(values, torch.tensor([0.5, 1.0, 1.0]))
    assert (result[1:-1, ..., 0] == 6).all()
    assert (result[[0, -1], ..., 0] == 3).all()
    assert (result[..., 1:] == 0).all()


def test_index_is_that_of_object_inside_and_air_outside(sphere: str) -> None:
    medium = VoxelGrid(sphere, ior=1.33, resolution=48, cache=False)
    n, grad = medium(torch.tensor([[0.0, 0.0, 0.0], [1.35, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, -0.8, 0.0]]))
    torch.testing.assert_close(n[:3], torch.tensor([1.33, 1.0, 1.0]))
    assert 1.05 < n[3] < 1.28
    assert (grad[:3] == 0).all()
    # The index rises towards the centre.
    assert grad[3, 1] > 1
    assert grad[3, [0, 2]].abs().max() < 0.1


def test_clearance_region_has_no_gradient() -> None:
    medium = VoxelGrid.from_occupancy(_ball_occupancy(32), BOX, 1.5, 5, 1.0)
    positions = torch.rand(500, 3) * 3 - 1.5
    clearance = medium.clearance(positions)
    assert (clearance > 0).float().mean() > 0.3
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    _, grad = medium(positions + 0.999 * clearance[:, None] * directions)
    assert (grad[clearance > 0] == 0).all()


def test_cached_occupancy_is_bit_for_bit_the_computed_one(
    sphere: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "cache"))
    tables = [VoxelGrid(sphere, resolution=40, cache=cache).table for cache in (False, True, True)]
    assert len(list((tmp_path / "cache").iterdir())) == 1
    torch.testing.assert_close(tables[1], tables[0], rtol=0, atol=0)
    torch.testing.assert_close(tables[2], tables[0], rtol=0, atol=0)


def test_grids_are_not_in_checkpoints() -> None:
    assert not VoxelGrid.from_occupancy(_ball_occupancy(16), BOX, 1.5, 3, 1.0).state_dict()


def test_box_suggested_by_the_margin_error_is_accepted(sphere: str) -> None:
    small: dict[str, list[float]] = {"box_min": [-0.8] * 3, "box_max": [0.8] * 3}
    message = refused("voxels of air", VoxelGrid, sphere, resolution=64, cache=False, **small)
    low, high = (part.split("[")[1].split("]")[0] for part in message.split("medium.box_")[1:])
    corners = [[float(number) for number in corner.split(",")] for corner in (low, high)]
    VoxelGrid(sphere, resolution=64, box_min=corners[0], box_max=corners[1], cache=False)
    with pytest.raises(NerfroError, match=r"box_min=.*box_max="):
        VoxelGrid(sphere, resolution=32, smoothing_size=3, box_max=[1.0, 0.8, 1.0], cache=False)


def test_grid_without_margin_is_refused() -> None:
    refused("touches the grid's border", VoxelGrid.from_occupancy, torch.ones(8, 8, 8), BOX, 1.5, 3, 1.0)
