"""Differentiable tracing of bent paths."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import Path, Rays
from nerfro.geometry.interpolation import intersect_box
from nerfro.media.base import Medium
from nerfro.paper.eikonal import Index, RayState, march_uniform
from nerfro.registry.allowed import Count
from nerfro.registry.registration import register
from nerfro.samplers.base import PathSampler, straight_path


@register("sampler/path", "box_march")
class BoxMarch(PathSampler):
    """Trace rays by equal steps of the Eikonal equation inside the medium's box, and straight outside.

    Gradients flow through all steps. The total length of the steps is the diagonal of the box; afterwards, a ray inside
    the box continues straight.

    Args:
        num_steps: number of steps inside the box.
    """

    ends_at_far = True

    def __init__(self, num_steps: Count = 32) -> None:
        super().__init__()
        self.num_steps = num_steps

    def forward(self, rays: Rays, medium: Medium) -> Path:
        """Trace every ray from near to far; gradients flow from the vertices to the medium's parameters."""
        straight = straight_path(rays)
        enter, leave = intersect_box(medium.box, straight.positions[:, 0], rays.directions)
        enter = enter.clamp(min=0)
        rows = ((enter < leave) & (enter < rays.far - rays.near)).nonzero().squeeze(1)
        # Marched even where no ray meets the box, so that the graph of a training step always reaches the medium.
        bent = self._march(rays[rows], rays.near[rows] + enter[rows], medium)
        last = torch.ones(self.num_steps + 3, dtype=torch.long, device=rows.device)
        last[0] = 0
        names = ("positions", "directions", "s")
        columns = (getattr(straight, name)[:, last].index_copy(0, rows, getattr(bent, name)) for name in names)
        positions, directions, s = columns
        refracted = straight.refracted.index_copy(0, rows, bent.refracted)
        return Path.unbranched(positions, directions, s, refracted, rays.radii)

    def replay(self, path: Path, rays: Rays, medium: Medium) -> Path:
        """Trace the path again; `forward` has gradients."""
        return self(rays, medium)

    def _march(self, rays: Rays, entry: Float[Tensor, "R"], medium: Medium) -> Path:
        diagonal = torch.linalg.vector_norm(medium.box[1] - medium.box[0])
        end = torch.minimum(entry + diagonal, rays.far)
        inner = march_uniform(
            Rays(rays.origins, rays.directions, rays.radii, entry, end), medium, unit_speed, self.num_steps + 1
        )
        # Along the chords, so that following a vertex's direction leads to the next one.
        chords = torch.nn.functional.normalize(inner.positions.diff(dim=1), dim=-1)
        far = torch.maximum(rays.far, inner.far)  # rounding may put the last step behind it
        start = rays.origins + rays.near[:, None] * rays.directions
        stop = inner.end_positions + (far - inner.far)[:, None] * inner.exit_directions
        return Path.unbranched(
            torch.cat([start[:, None], inner.positions, stop[:, None]], 1),
            torch.cat([rays.directions[:, None], chords, inner.exit_directions[:, None].expand(-1, 2, -1)], 1),
            torch.cat([rays.near[:, None], inner.s, far[:, None]], 1),
            inner.refracted,
            rays.radii,
        )


def unit_speed(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """Take a kick-drift-kick step: x + ds v / |v| between two halves of v + ds grad n; second order, one lookup.

    As in the authors' code, only the gradient of the index acts, so a constant in the index has no effect. An explicit
    Euler step costs the same, but a wrong index would compensate the integration error.
    """
    x, v, _, g = state
    half = v + 0.5 * ds[:, None] * g
    x = x + ds[:, None] * torch.nn.functional.normalize(half, dim=-1)
    n, g = index(x)
    return RayState(x, half + 0.5 * ds[:, None] * g, n, g)
