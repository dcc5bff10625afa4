"""Template: a path sampler of your own in one file. Use it with `sampler/path=mirror_floor`."""

from __future__ import annotations

import torch

from nerfro.parts import Medium, Path, PathSampler, Rays, register


@register("sampler/path", "mirror_floor")
class MirrorFloor(PathSampler):
    """Reflect rays at a horizontal mirror below the scene.

    Args:
        height: z coordinate of the mirror, world units.
    """

    needs_medium = False

    def __init__(self, height: float = -1.0) -> None:
        super().__init__()
        self.height = height

    @torch.no_grad()
    def forward(self, rays: Rays, medium: Medium) -> Path:
        meets = (self.height - rays.origins[:, 2]) / rays.directions[:, 2]
        reflected = (meets > rays.near) & (meets < rays.far)  # false for a direction parallel to the mirror
        # Three vertices: near, the mirror, far. Rays that miss the mirror have their second vertex at far.
        middle = torch.where(reflected, meets, rays.far)
        s = torch.stack([rays.near, middle, rays.far], -1)
        after = torch.where(
            reflected[:, None], rays.directions * rays.directions.new_tensor([1, 1, -1]), rays.directions
        )
        directions = torch.stack([rays.directions, after, after], 1)
        start, turn = (rays.origins + distance[:, None] * rays.directions for distance in (rays.near, middle))
        positions = torch.stack([start, turn, turn + (rays.far - middle)[:, None] * after], 1)
        return Path.unbranched(positions, directions, s, reflected, rays.radii)
