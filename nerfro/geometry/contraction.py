"""Contraction of all of space into a ball: positions, and lengths along lines.

Source: Barron et al., mip-NeRF 360, 2022, Eqn. 10.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Stand-in for infinity, in units of the ball's radius, or of the line's distance if the line misses the ball.
FAR = 1e4
# Distance from the centre, in radii, below which a line counts as passing through the centre.
NEAREST = 1e-6


def contract(x: Float[Tensor, "*batch 3"], centre: Float[Tensor, "3"], radius: float) -> Float[Tensor, "*batch 3"]:
    """Contract the space outside a ball to the shell between the ball and twice its radius.

    Positions within the ball stay. The offset y from the centre becomes (2 - R / |y|) R y / |y| where |y| > R.
    """
    offset = x - centre
    share = radius / offset.norm(dim=-1, keepdim=True).clamp(min=radius)
    return centre + (2 - share) * share * offset


def expand(x: Float[Tensor, "*batch 3"], centre: Float[Tensor, "3"], radius: float) -> Float[Tensor, "*batch 3"]:
    """Invert `contract`; positions at twice the radius or beyond are mapped to a large distance."""
    offset = x - centre
    norm = offset.norm(dim=-1, keepdim=True).clamp(min=radius)
    return centre + offset * (radius / norm) / (2 - norm / radius).clamp(min=1 / FAR)


def contraction_scale(
    x: Float[Tensor, "*batch 3"], centre: Float[Tensor, "3"], radius: float
) -> Float[Tensor, "*batch"]:
    """Return the scale of lengths under contraction, min(1, R^2 / |y|^2); exact along lines from the centre."""
    return (radius**2 / (x - centre).square().sum(-1)).clamp(max=1)


def contracted_box(box: Float[Tensor, "2 3"], radius: float) -> Float[Tensor, "2 3"]:
    """Return the corners of the cube around contracted space, for a ball around the middle of a box."""
    reach = 2 * radius * torch.tensor([[-1.0], [1.0]])
    return box.mean(0) + reach


def contracted_length(
    t: Float[Tensor, "*batch"], impact_parameter: Float[Tensor, "*#batch"], radius: float
) -> Float[Tensor, "*batch"]:
    """Integrate the contraction scale along a line, from the point of closest approach to arc length `t` from there.

    With b = sqrt(max(R^2 - a^2, 0)), half the length of the line within the ball, the result is t where |t| < b, and
    b + R^2 / a (atan(t / a) - atan(b / a)) with the sign of t elsewhere.

    Args:
        t: arc length, world units.
        impact_parameter: distance a of the line from the centre, world units.
        radius: radius R of the ball that is not contracted.
    """
    a = impact_parameter.clamp(min=NEAREST * radius)
    within = (radius**2 - a.square()).clamp(min=0).sqrt()
    beyond = t.abs().maximum(within)
    angle = torch.atan2(a * (beyond - within), a.square() + beyond * within)
    return t.sign() * (t.abs().minimum(within) + radius**2 / a * angle)


def world_length(
    length: Float[Tensor, "*batch"], impact_parameter: Float[Tensor, "*#batch"], radius: float
) -> Float[Tensor, "*batch"]:
    """Invert `contracted_length` for arc lengths up to `FAR`."""
    a = impact_parameter.clamp(min=NEAREST * radius)
    within = (radius**2 - a.square()).clamp(min=0).sqrt()
    tangent = torch.tan((length.abs() - within).clamp(min=0) * a / radius**2)
    beyond = a * (within + a * tangent) / (a - within * tangent)
    return length.sign() * torch.where(length.abs() <= within, length.abs(), beyond)
