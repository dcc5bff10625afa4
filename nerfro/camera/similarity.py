"""How cameras moved on the whole."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

_ITERATIONS = 10  # rotation and scale depend on each other


class Similarity(NamedTuple):
    """x -> scale * rotation x + shift, of the world."""

    scale: Float[Tensor, ""]
    rotation: Float[Tensor, "3 3"]
    shift: Float[Tensor, "3"]

    def moved(self, poses: Float[Tensor, "V 3 4"]) -> Float[Tensor, "V 3 4"]:
        """Cameras that go along."""
        centres = self.scale * poses[..., 3] @ self.rotation.T + self.shift
        return torch.cat([self.rotation @ poses[..., :3], centres[..., None]], -1)


def similarity(
    old: Float[Tensor, "V 3 4"],
    new: Float[Tensor, "V 3 4"],
    of_turns: Float[Tensor, "V"],
    of_shifts: Float[Tensor, "V"],
) -> Similarity:
    """The similarity that moves cameras nearest to others (Umeyama, 1991, with the cameras' axes beside their centres).

    Least squares of the angles and distances that are left, each times the weight of its camera. Axes tell the rotation
    where centres lie on a line, too.
    """
    turns, shifts = of_turns.square(), of_shifts.square()
    middles = [(shifts[:, None] * poses[..., 3]).sum(0) / shifts.sum() for poses in (old, new)]
    before, after = (poses[..., 3] - middle for poses, middle in zip((old, new), middles, strict=True))
    scale, rotation = torch.ones_like(shifts[0]), torch.eye(3).to(old)
    for _ in range(_ITERATIONS):
        # For small angles, the squared distance of two rotations is twice their angle's square.
        both = torch.einsum("v,vij,vkj->ik", 0.5 * turns, new[..., :3], old[..., :3])
        both = both + scale * torch.einsum("v,vi,vk->ik", shifts, after, before)
        u, _, v = torch.linalg.svd(both)
        sign = torch.linalg.det(u @ v)
        rotation = u @ torch.diag(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign])) @ v
        spread = (shifts * before.square().sum(-1)).sum()
        along = (shifts * (after * (before @ rotation.T)).sum(-1)).sum()
        # One camera alone, or several in one place, tell no scale.
        scale = torch.where(spread > torch.finfo(spread.dtype).tiny, along / spread, torch.ones_like(spread))
    return Similarity(scale, rotation, middles[1] - scale * rotation @ middles[0])


def motion_between(
    old: Float[Tensor, "V 3 4"], new: Float[Tensor, "V 3 4"]
) -> tuple[Float[Tensor, "V"], Float[Tensor, "V"]]:
    """By how many degrees cameras are turned, and how far their centres are shifted, world units."""
    old, new = old.double(), new.double()
    chord = (new[..., :3] - old[..., :3]).norm(dim=(-2, -1)) / math.sqrt(8)  # the sine of half the angle
    return torch.rad2deg(2 * torch.asin(chord.clamp(max=1))), (new[..., 3] - old[..., 3]).norm(dim=-1)
