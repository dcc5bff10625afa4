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
    turning = path.refracted.nonzero()[:, 0]  # only few rays of an image
    bent = path[turning]
    rows = torch.arange(len(turning), device=path.s.device)
    before, after = bent.directions[:, :-1], bent.directions[:, 1:]
    body = torch.zeros_like(bent.s).long() if bent.record is None else bent.record.body.long()
    n = indices_of(medium, bent.s).detach()[body]
    events = (before != after).any(-1) | (n[:, :-1] != n[:, 1:])
    first = events.byte().argmax(-1)
    arriving = before[rows, first]
    if medium.bodies is not None:
        normals = turning_normals(arriving, after[rows, first], n[rows, first], n[rows, first + 1])
    else:
        _, normals = medium(bent.positions[rows, first + 1])
    towards = -(normals * arriving).sum(-1, keepdim=True).sign()
    normals = torch.where(events.any(-1, keepdim=True), functional.normalize(normals * towards, dim=-1), 0.0)
    all_normals = path.directions.new_zeros(len(path.s), 3)
    all_normals[turning] = normals.to(all_normals)
    return path.main_polyline(all_normals)
