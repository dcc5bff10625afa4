"""Straight paths, as in ordinary radiance fields."""

from __future__ import annotations

from dataclasses import replace

import torch

from nerfro.core.types import Path, Rays
from nerfro.media.base import Medium
from nerfro.registry.registration import register
from nerfro.samplers.base import PathSampler


@register("sampler/path", "straight")
class Straight(PathSampler):
    """Trace straight rays, o + s d, and ignore the medium."""

    needs_medium = False

    @torch.no_grad()
    def forward(self, rays: Rays, medium: Medium) -> Path:
        """Return a path of two vertices for each ray."""
        return straight_path(rays)

    def releases_gil(self, medium: Medium) -> bool:
        return True

    def replay(self, path: Path, rays: Rays, medium: Medium) -> Path:
        return replay_straight(path, rays)


def straight_path(rays: Rays) -> Path:
    """Return paths of two vertices, at near and far."""
    s = torch.stack([rays.near, rays.far], -1)
    positions = rays.origins[:, None] + s[..., None] * rays.directions[:, None]
    directions = rays.directions[:, None].expand_as(positions)
    refracted = torch.zeros(len(rays), dtype=torch.bool, device=s.device)
    return Path.unbranched(positions, directions, s, refracted, rays.radii)


def replay_straight(path: Path, rays: Rays) -> Path:
    """Return straight paths with gradients with respect to the rays."""
    lines = straight_path(rays[path.ray])
    return replace(path, positions=lines.positions, directions=lines.directions, s=lines.s)
