"""What both ways in which cameras take steps of Gauss-Newton share: directions of differences, and robust weights."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, one_hot


def axes_across(directions: Float[Tensor, "R 3"]) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Two unit axes for each unit direction, perpendicular to it and to each other."""
    least = one_hot(directions.abs().argmin(-1), 3).to(directions)
    first = normalize(torch.linalg.cross(directions, least), dim=-1)
    return first, torch.linalg.cross(directions, first)


def robust_weights(error: Float[Tensor, "R 3"], scale: float) -> Float[Tensor, "R"]:
    """Weights of least squares by which colours that are off by more than `scale` count less (Geman and McClure)."""
    return 1 / (1 + (error / scale).square().sum(-1)).square()
