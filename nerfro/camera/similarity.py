"""Similarity transformations between two sets of cameras."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Similarity(NamedTuple):
    """Similarity transformation of the world, x -> scale * rotation x + shift."""

    scale: Float[Tensor, ""]
    rotation: Float[Tensor, "3 3"]
    shift: Float[Tensor, "3"]

    def apply(self, poses: Float[Tensor, "V 3 4"]) -> Float[Tensor, "V 3 4"]:
        """Transform camera-to-world matrices; the scale acts on the centres only."""
        centres = self.scale * poses[..., 3] @ self.rotation.T + self.shift
        return torch.cat([self.rotation @ poses[..., :3], centres[..., None]], -1)


def similarity(
    old: Float[Tensor, "V 3 4"],
    new: Float[Tensor, "V 3 4"],
    rotation_weights: Float[Tensor, "V"],
    shift_weights: Float[Tensor, "V"],
) -> Similarity:
    """Fit the similarity transformation from `old` to `new` cameras.

    The sum of squared weighted angles and distances between transformed and new cameras is minimal. In contrast to
    Umeyama (1991), who uses points only, camera axes determine the rotation even if the centres lie on a line.

    Args:
        old, new: camera-to-world matrices, world units.
        rotation_weights, shift_weights: weight of angle and distance of each camera.
    """
    turns, shifts = rotation_weights.square(), shift_weights.square()
    means = [(shifts[:, None] * poses[..., 3]).sum(0) / shifts.sum() for poses in (old, new)]
    before, after = (poses[..., 3] - mean for poses, mean in zip((old, new), means, strict=True))
    scale, rotation = torch.ones_like(shifts[0]), torch.eye(3).to(old)
    # Updates of rotation and scale alternate.
    for _ in range(10):
        # For small angles, the squared distance of two rotation matrices is twice the square of the angle.
        both = torch.einsum("v,vij,vkj->ik", 0.5 * turns, new[..., :3], old[..., :3])
        both = both + scale * torch.einsum("v,vi,vk->ik", shifts, after, before)
        u, _, v = torch.linalg.svd(both)
        sign = torch.linalg.det(u @ v)
        rotation = u @ torch.diag(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign])) @ v
        spread = (shifts * before.square().sum(-1)).sum()
        along = (shifts * (after * (before @ rotation.T)).sum(-1)).sum()
        # Cameras at a single position do not determine the scale.
        scale = torch.where(spread > torch.finfo(spread.dtype).tiny, along / spread, torch.ones_like(spread))
    return Similarity(scale, rotation, means[1] - scale * rotation @ means[0])


def motion_between(
    old: Float[Tensor, "V 3 4"], new: Float[Tensor, "V 3 4"]
) -> tuple[Float[Tensor, "V"], Float[Tensor, "V"]]:
    """Return the rotation angle of each camera in degrees, and the distance of its centres in world units."""
    old, new = old.double(), new.double()
    chord = (new[..., :3] - old[..., :3]).norm(dim=(-2, -1)) / math.sqrt(8)  # the sine of half the angle
    return torch.rad2deg(2 * torch.asin(chord.clamp(max=1))), (new[..., 3] - old[..., 3]).norm(dim=-1)
