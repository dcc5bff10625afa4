"""All of space in a ball: places, and lengths along lines.

Source: Barron et al., mip-NeRF 360, 2022, Eqn. 10.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# What stands for infinity, in units of the ball's radius or, for a line that misses the ball, of its distance.
FAR = 1e4
# Distance from the centre, in radii, at which a line is taken to pass through it.
NEAREST = 1e-6


def contract(x: Float[Tensor, "*batch 3"], centre: Float[Tensor, "3"], radius: float) -> Float[Tensor, "*batch 3"]:
    """Space within a ball as it is, and all that is beyond between it and the ball of twice its radius.

    The offset y from the centre becomes (2 - R / |y|) R y / |y| where |y| > R.
    """
    offset = x - centre
    share = radius / offset.norm(dim=-1, keepdim=True).clamp(min=radius)
    return centre + (2 - share) * share * offset


def expand(x: Float[Tensor, "*batch 3"], centre: Float[Tensor, "3"], radius: float) -> Float[Tensor, "*batch 3"]:
    """The inverse of `contract`; what lies at twice the radius or beyond comes to lie far away."""
    offset = x - centre
    norm = offset.norm(dim=-1, keepdim=True).clamp(min=radius)
    return centre + offset * (radius / norm) / (2 - norm / radius).clamp(min=1 / FAR)


def shrinkage(x: Float[Tensor, "*batch 3"], centre: Float[Tensor, "3"], radius: float) -> Float[Tensor, "*batch"]:
    """How much shorter lengths are after contraction: min(1, R^2 / |y|^2), which is exact for lines from the centre."""
    return (radius**2 / (x - centre).square().sum(-1)).clamp(max=1)


def contracted_box(box: Float[Tensor, "2 3"], radius: float) -> Float[Tensor, "2 3"]:
    """Corners of the cube around all of contracted space, for a ball around the middle of a box."""
    reach = 2 * radius * torch.tensor([[-1.0], [1.0]])
    return box.mean(0) + reach


def contracted_length(
    t: Float[Tensor, "*batch"], aside: Float[Tensor, "*#batch"], radius: float
) -> Float[Tensor, "*batch"]:
    """Integral of the shrinkage along a line, from the place nearest to the centre to arc length `t` from there.

    With b = sqrt(max(R^2 - a^2, 0)), half the line's run within the ball: t where |t| < b, and beyond
    b + R^2 / a (atan(t / a) - atan(b / a)), with the sign of t.

    Args:
        t: arc length, world units.
        aside: distance a of the line from the centre.
        radius: R, of the ball that is left as it is.
    """
    a = aside.clamp(min=NEAREST * radius)
    within = (radius**2 - a.square()).clamp(min=0).sqrt()
    beyond = t.abs().maximum(within)
    angle = torch.atan2(a * (beyond - within), a.square() + beyond * within)
    return t.sign() * (t.abs().minimum(within) + radius**2 / a * angle)


def world_length(
    length: Float[Tensor, "*batch"], aside: Float[Tensor, "*#batch"], radius: float
) -> Float[Tensor, "*batch"]:
    """The inverse of `contracted_length`, for lengths that it returns for `FAR` or less."""
    a = aside.clamp(min=NEAREST * radius)
    within = (radius**2 - a.square()).clamp(min=0).sqrt()
    tangent = torch.tan((length.abs() - within).clamp(min=0) * a / radius**2)
    beyond = a * (within + a * tangent) / (a - within * tangent)
    return length.sign() * torch.where(length.abs() <= within, length.abs(), beyond)
