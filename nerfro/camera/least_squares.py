"""What all ways in which cameras take steps of Gauss-Newton share: equations, robust weights, what is known already."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize, one_hot

# Of the mean of the normal equations' diagonal, added to it.
DAMPING = 1e-3
_TINY = 1e-9


@dataclass(frozen=True)
class Told:
    """What is known of all cameras together.

    Attributes:
        numbers: six of each camera, then the lens where it is refined, as `RefinedCamera` counts them: pixels.
        information: the inverse of their covariance; 0 along what is not told.
    """

    numbers: Float[Tensor, "N"]
    information: Float[Tensor, "N N"]


def axes_across(directions: Float[Tensor, "R 3"]) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Two unit axes for each unit direction, perpendicular to it and to each other."""
    least = one_hot(directions.abs().argmin(-1), 3).to(directions)
    first = normalize(torch.linalg.cross(directions, least), dim=-1)
    return first, torch.linalg.cross(directions, first)


def robust_weights(error: Float[Tensor, "R 3"], scale: float) -> Float[Tensor, "R"]:
    """Weights of least squares by which colours that are off by more than `scale` count less (Geman and McClure)."""
    return 1 / (1 + (error / scale).square().sum(-1)).square()


def normal_equations(
    slopes: Float[Tensor, "R C N"],
    error: Float[Tensor, "R C"],
    weights: Float[Tensor, "R"],
    view: Int[Tensor, "R"],
    num_views: int,
    damping: float = DAMPING,
) -> tuple[Float[Tensor, "M M"], Float[Tensor, "M"]]:
    """Normal equations of all cameras' six numbers, and of those that all share behind them.

    `damping` is added to the diagonal, a share of its mean: what is not told of a camera stays.
    """
    num = slopes.shape[-1]
    squares = torch.einsum("r,rci,rcj->rij", weights, slopes, slopes)
    products = torch.einsum("r,rci,rc->ri", weights, slopes, error)
    each = slopes.new_zeros(num_views, num, num).index_add(0, view, squares)
    gradient = slopes.new_zeros(num_views, num).index_add(0, view, products)
    own, shared = each[:, :6, :6], each[:, 6:, 6:].sum(0)
    added = damping * own.diagonal(dim1=1, dim2=2).mean(-1) + _TINY
    own = own + added[:, None, None] * torch.eye(6).to(own)
    shared = shared + (damping * shared.trace() / max(len(shared), 1) + _TINY) * torch.eye(num - 6).to(shared)
    together = each[:, :6, 6:].flatten(0, 1)
    matrix = torch.cat([torch.block_diag(*own), together], 1)
    matrix = torch.cat([matrix, torch.cat([together.mT, shared], 1)])
    return matrix, torch.cat([gradient[:, :6].flatten(), gradient[:, 6:].sum(0)])


def with_told(
    matrix: Float[Tensor, "N N"],
    vector: Float[Tensor, "N"],
    numbers: Float[Tensor, "N"],
    variance: Float[Tensor, ""] | float,
    told: Iterable[Told],
) -> tuple[Float[Tensor, "N N"], Float[Tensor, "N"]]:
    """Normal equations joined with what is told already, each in units of its own errors' variance.

    Args:
        matrix, vector: of errors that have this variance.
        numbers: where all are now.
        variance: of the errors.
        told: what is known.
    """
    for each in told:
        # What a checkpoint brings is on the CPU.
        information = variance * each.information.to(matrix)
        matrix = matrix + information
        vector = vector + information @ (numbers - each.numbers.to(numbers)).to(vector)
    return matrix, vector
