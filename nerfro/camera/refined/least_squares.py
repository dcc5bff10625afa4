"""Common parts of the Gauss-Newton solvers for cameras: normal equations, robust weights and priors."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from nerfro.core.robust import geman_mcclure_weight

TINY = 1e-9  # lower bound of divisors


@dataclass(frozen=True)
class PriorInformation:
    """Gaussian prior of the parameters of all cameras.

    Attributes:
        mean: mean of the parameters in pixels: six per camera, followed by the lens if it is refined (see
            `RefinedCamera.parameter_vector`).
        information: information matrix, the inverse of the covariance; zero for directions without information.
    """

    mean: Float[Tensor, " parameters"]
    information: Float[Tensor, "parameters parameters"]


def axes_across(directions: Float[Tensor, "R 3"]) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Return two unit axes that are perpendicular to each direction and to each other."""
    least = one_hot(directions.abs().argmin(-1), 3).to(directions)
    first = normalize(torch.linalg.cross(directions, least), dim=-1)
    return first, torch.linalg.cross(directions, first)


def shortened(steps: Float[Tensor, "*steps N"], longest: float) -> Float[Tensor, "*steps N"]:
    """Shorten vectors to a largest length."""
    return steps * (longest / steps.norm(dim=-1, keepdim=True).clamp(min=TINY)).clamp(max=1)


def robust_weights(error: Float[Tensor, "R 3"], scale: float) -> Float[Tensor, "R"]:
    """Compute Geman-McClure weights of errors of three channels.

    In contrast to `nerfro.core.robust`, `scale` refers to the Euclidean norm over the channels, not to their root mean
    square, which is smaller by the square root of 3.
    """
    return geman_mcclure_weight(error, scale / math.sqrt(error.shape[-1]))


def normal_equations(
    slopes: Float[Tensor, "R C parameters"],
    error: Float[Tensor, "R C"],
    weights: Float[Tensor, "R"],
    view: Int[Tensor, "R"],
    num_views: int,
    damping: float = 1e-3,
) -> tuple[Float[Tensor, "M M"], Float[Tensor, "M"]]:
    """Accumulate the normal equations of all cameras.

    Args:
        slopes: derivatives of C residuals by N parameters: six of the camera, followed by the shared parameters.
        error: residuals.
        weights: weight of each observation.
        view: index of the camera of each observation.
        num_views: number of cameras V.
        damping: damping relative to the mean of the diagonal, which keeps undetermined parameters unchanged.

    Returns:
        Matrix and gradient for 6 V camera parameters, followed by the shared parameters.
    """
    num = slopes.shape[-1]
    squares = torch.einsum("r,rci,rcj->rij", weights, slopes, slopes)
    products = torch.einsum("r,rci,rc->ri", weights, slopes, error)
    of_views = slopes.new_zeros(num_views, num, num).index_add(0, view, squares)
    gradient = slopes.new_zeros(num_views, num).index_add(0, view, products)
    own, shared = of_views[:, :6, :6], of_views[:, 6:, 6:].sum(0)
    added = damping * own.diagonal(dim1=1, dim2=2).mean(-1) + TINY
    own = own + added[:, None, None] * torch.eye(6).to(own)
    shared = shared + (damping * shared.trace() / max(len(shared), 1) + TINY) * torch.eye(num - 6).to(shared)
    mixed = of_views[:, :6, 6:].flatten(0, 1)
    matrix = torch.cat([torch.block_diag(*own), mixed], 1)
    matrix = torch.cat([matrix, torch.cat([mixed.mT, shared], 1)])
    return matrix, torch.cat([gradient[:, :6].flatten(), gradient[:, 6:].sum(0)])


def with_priors(
    matrix: Float[Tensor, "parameters parameters"],
    vector: Float[Tensor, " parameters"],
    parameters: Float[Tensor, " parameters"],
    variance: Float[Tensor, ""] | float,
    priors: Iterable[PriorInformation],
) -> tuple[Float[Tensor, "parameters parameters"], Float[Tensor, " parameters"]]:
    """Add priors to normal equations.

    Args:
        matrix, vector: matrix and gradient of the normal equations.
        parameters: current parameters in pixels.
        variance: variance of the residuals, which scales the priors.
        priors: priors of the parameters.
    """
    for prior in priors:
        # Checkpoints are read to the CPU.
        information = variance * prior.information.to(matrix)
        matrix = matrix + information
        vector = vector + information @ (parameters - prior.mean.to(parameters)).to(vector)
    return matrix, vector
