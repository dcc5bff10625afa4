"""How cameras moved on the whole."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Similarity(NamedTuple):
    """x -> scale * rotation x + shift, of the world."""

    scale: Float[Tensor, ""]
    rotation: Float[Tensor, "3 3"]
    shift: Float[Tensor, "3"]

    def moved(self, poses: Float[Tensor, "V 3 4"]) -> Float[Tensor, "V 3 4"]:
        """Cameras that go along."""
        centres = self.scale * poses[..., 3] @ self.rotation.T + self.shift
        return torch.cat([self.rotation @ poses[..., :3], centres[..., None]], -1)


def similarity(old: Float[Tensor, "V 3 4"], new: Float[Tensor, "V 3 4"]) -> Similarity:
    """The similarity that moves cameras nearest to others (Umeyama, 1991, with the cameras' axes beside their centres).

    The axes tell the rotation where centres lie on a line, too.
    """
    middle_old, middle_new = old[..., 3].mean(0), new[..., 3].mean(0)
    before, after = old[..., 3] - middle_old, new[..., 3] - middle_new
    spread = before.square().sum()
    tiny = torch.finfo(spread.dtype).tiny
    both = torch.einsum("vij,vkj->ik", new[..., :3], old[..., :3]) / len(old)
    both = both + torch.einsum("vi,vk->ik", after, before) / spread.clamp(min=tiny)
    u, _, v = torch.linalg.svd(both)
    sign = torch.linalg.det(u @ v)
    rotation = u @ torch.diag(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign])) @ v
    along = (after * (before @ rotation.T)).sum()
    scale = torch.where(spread > tiny, along / spread.clamp(min=tiny), torch.ones_like(spread))
    return Similarity(scale, rotation, middle_new - scale * rotation @ middle_old)


def motion_between(
    old: Float[Tensor, "V 3 4"], new: Float[Tensor, "V 3 4"]
) -> tuple[Float[Tensor, "V"], Float[Tensor, "V"]]:
    """By how many degrees cameras are turned, and how far their centres are shifted, world units."""
    old, new = old.double(), new.double()
    chord = (new[..., :3] - old[..., :3]).norm(dim=(-2, -1)) / math.sqrt(8)  # the sine of half the angle
    return torch.rad2deg(2 * torch.asin(chord.clamp(max=1))), (new[..., 3] - old[..., 3]).norm(dim=-1)
