"""A ball in a ball, in closed form and as meshes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import trimesh
from torch import Tensor

from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from tests.closed_forms import FreeBodies, grid_points, sampled


class NestedBalls(FreeBodies):
    """A ball in a ball in closed form."""

    def __init__(self, shell: float = 0.02) -> None:
        super().__init__([1.5, 1.2], shell, torch.tensor([[-1.2] * 3, [1.2] * 3], dtype=torch.float64))

    def signed_distances(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        centres = torch.tensor([[0, 0, 0], [0.2, 0.1, 0]], dtype=torch.float64)
        offsets = positions[..., None, :] - centres
        distances = torch.linalg.vector_norm(offsets, dim=-1)
        return distances - torch.tensor([0.8, 0.4], dtype=torch.float64), offsets / distances[..., None]


def nested_mesh(folder: Path) -> Bodies:
    """The same balls as meshes."""
    outer, inner = trimesh.creation.icosphere(3, 0.8), trimesh.creation.icosphere(3, 0.4)
    inner.apply_translation([0.2, 0.1, 0])
    files = [str(folder / name) for name in ("outer.ply", "inner.ply")]
    outer.export(files[0])
    inner.export(files[1])
    bodies = {"outer": {"mesh": files[0], "ior": 1.5}, "inner": {"mesh": files[1], "ior": 1.2}}
    return make_bodies(bodies=bodies, resolution=32, cache=False).double()


def nested_grid(half_side: float, size: int, iors: Sequence[float], **glass: Any) -> Bodies:
    """The same balls on a grid, in double precision."""
    distances, _ = NestedBalls().signed_distances(grid_points(half_side, size, torch.float64))
    box = torch.tensor([[-half_side] * 3, [half_side] * 3], dtype=torch.float64)
    return sampled(distances.movedim(-1, 0), box, iors, 0.02, **glass)
