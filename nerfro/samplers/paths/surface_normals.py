"""Surface normals for images and exports, from the change of direction at the first surface of each path."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.core.types import Path
from nerfro.media.base import Medium
from nerfro.samplers.paths.replay import indices_of
from nerfro.samplers.paths.snell_law import turning_normals


def first_normals(path: Path, medium: Medium) -> Float[Tensor, "R 3"]:
    """Compute unit normals, towards the camera, at the first event of each ray; zero for rays without events.

    If the index varies continuously, the normals of its level surfaces at the first bend of each path are returned.
    """
    normals = path.directions.new_zeros(len(path.s), 3)
    rows = path.refracted.nonzero()[:, 0]  # only few rays of an image
    normals[rows] = _bent_normals(path[rows], medium).to(normals)
    return path.main_polyline(normals)


def _bent_normals(path: Path, medium: Medium) -> Float[Tensor, "P 3"]:
    """Compute the normals of polylines that intersect the medium."""
    rows = torch.arange(len(path.s), device=path.s.device)
    before, after = path.directions[:, :-1], path.directions[:, 1:]
    n = indices_of(medium, path.s).detach()[path.body.long()]
    events = (before != after).any(-1) | (n[:, :-1] != n[:, 1:])
    first = events.byte().argmax(-1)
    arriving = before[rows, first]
    if medium.bodies is not None:
        normals = turning_normals(arriving, after[rows, first], n[rows, first], n[rows, first + 1])
    else:
        _, normals = medium(path.positions[rows, first + 1])
    towards = -(normals * arriving).sum(-1, keepdim=True).sign()
    return torch.where(events.any(-1, keepdim=True), functional.normalize(normals * towards, dim=-1), 0.0)
