"""A ball in a ball, in closed form and as meshes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import trimesh
from torch import Tensor

from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.solid import Solid
from tests.closed_forms import grid_points


class NestedBalls(Solid):
    """A ball in a ball in closed form."""

    box = torch.tensor([[-1.2] * 3, [1.2] * 3], dtype=torch.float64)

    def __init__(self, shell: float = 0.02) -> None:
        super().__init__([1.5, 1.2], shell)

    def signed_distances(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        centres = torch.tensor([[0, 0, 0], [0.2, 0.1, 0]], dtype=torch.float64)
        offsets = positions[..., None, :] - centres
        distances = torch.linalg.vector_norm(offsets, dim=-1)
        return distances - torch.tensor([0.8, 0.4], dtype=torch.float64), offsets / distances[..., None]


def nested_mesh(folder: Path) -> SdfGrid:
    """The same balls as meshes."""
    outer, inner = trimesh.creation.icosphere(3, 0.8), trimesh.creation.icosphere(3, 0.4)
    inner.apply_translation([0.2, 0.1, 0])
    files = [str(folder / name) for name in ("outer.ply", "inner.ply")]
    outer.export(files[0])
    inner.export(files[1])
    return SdfGrid(files[0], 1.5, files[1:], [1.2], resolution=32, cache=False).double()


def nested_grid(half_side: float, size: int, iors: Sequence[float], **glass: Any) -> SdfGrid:
    """The same balls on a grid, in double precision."""
    distances, _ = NestedBalls().signed_distances(grid_points(half_side, size, torch.float64))
    box = torch.tensor([[-half_side] * 3, [half_side] * 3], dtype=torch.float64)
    return SdfGrid.from_distances(distances.movedim(-1, 0), box, iors, 0.02, **glass)
