"""The surface's normal where a path first meets it, told by how the path turns there."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.media.base import Medium
from nerfro.media.solid import Solid
from nerfro.types import Path


def first_normals(path: Path, medium: Medium) -> Float[Tensor, "R 3"]:
    """Unit normals, towards the camera, at the first event of each ray; zero where it meets nothing.

    Snell's law says that n' d' - n d is along the normal, for reflected light with n' = n. Where the index varies
    continuously, the normal is that of its level surfaces at the first vertex where the path turns.
    """
    normals = path.directions.new_zeros(len(path.s), 3)
    rows = path.refracted.nonzero()[:, 0]  # which few rays of a picture are
    normals[rows] = _turning_normals(path[rows], medium).to(normals)
    return path.first_of_ray(normals)


def _turning_normals(path: Path, medium: Medium) -> Float[Tensor, "P 3"]:
    """The same of polylines that meet the medium."""
    before, after = path.directions[:, :-1], path.directions[:, 1:]
    turns = (before != after).any(-1)
    first = turns.byte().argmax(-1)[:, None]

    def there(values: Tensor) -> Tensor:
        index = first if values.ndim == 2 else first[..., None].expand(-1, 1, values.shape[-1])
        return values.gather(1, index)[:, 0]

    arriving = there(before)
    if isinstance(medium, Solid):
        iors = torch.cat([medium.iors.new_ones(1), medium.iors.detach()]).to(before)
        bodies = path.body.long()
        n_before, n_after = (iors[there(body)][:, None] for body in (bodies[:, :-1], bodies[:, 1:]))
        normals = n_after * there(after) - n_before * arriving
    else:
        _, normals = medium(there(path.positions[:, 1:]))
    towards = -(normals * arriving).sum(-1, keepdim=True).sign()
    normals = functional.normalize(normals * towards, dim=-1)
    return torch.where(turns.any(-1, keepdim=True), normals, 0.0)
