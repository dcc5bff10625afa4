"""Errors of candidates on a grid: means over views, minima between the candidates, and standard errors.

The errors of each candidate are summed by view, so that random samples of the views give standard errors (bootstrap).
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float, Num

MIN_VIEWS = 5  # with pixels, for a standard error: resampling of fewer views underestimates the error


def bootstrap_weights(counts: Float[np.ndarray, "V"], num_samples: int = 200) -> Float[np.ndarray, "resamples V"]:
    """Return how often each view is drawn in random samples of the views with pixels."""
    num_views = int(np.count_nonzero(counts))
    drawn = np.random.default_rng(0).multinomial(num_views, (counts > 0) / max(1, num_views), num_samples)
    return drawn.astype(np.float64)


def standard_error(
    samples: Float[np.ndarray, " resamples *indices"], counts: Float[np.ndarray, "V"]
) -> Float[np.ndarray, "*indices"]:
    """Compute the standard deviation of estimates from random samples of the views; infinite for too few views."""
    return np.where(np.count_nonzero(counts) < MIN_VIEWS, np.inf, samples.std(0))


def mean_errors(
    sums: Float[np.ndarray, "candidates V"],
    counts: Float[np.ndarray, "V"],
    weights: Num[np.ndarray, "resamples V"] | int = 1,
) -> Float[np.ndarray, "resamples candidates"]:
    """Average errors that are summed by view over all pixels, optionally for several weightings of the views."""
    weights = np.atleast_2d(weights * np.ones_like(counts))
    return (weights @ sums.T) / (weights @ counts)[:, None].clip(1)


def quadratic_minimum(
    candidates: Float[np.ndarray, "candidates indices"],
    errors: Float[np.ndarray, "resamples candidates"],
    axes: Float[np.ndarray, "indices indices"],
    max_extrapolation: float = 1.5,
) -> tuple[Float[np.ndarray, "resamples indices"], Float[np.ndarray, "resamples indices"]]:
    """Fit a quadratic function to the errors of all candidates by least squares, and find its minimum.

    Args:
        candidates: points of the grid.
        errors: one set of errors for each weighting.
        axes: half axes of the grid, in columns.
        max_extrapolation: largest distance of the minimum from the centre of the grid, relative to the half axes.

    Returns:
        The minima, or the best candidates for functions without a minimum near the grid; and the second derivatives of
        the functions by each index.
    """
    count, centre = candidates.shape[1], candidates.mean(0)
    inverse = np.linalg.inv(axes)
    x = (candidates - centre) @ inverse.T
    pairs = list(itertools.combinations_with_replacement(range(count), 2))
    terms = np.stack([np.ones(len(x)), *x.T, *(x[:, i] * x[:, j] for i, j in pairs)], 1)
    coefficients = errors @ np.linalg.pinv(terms).T
    hessian = np.zeros((len(errors), count, count))
    for (i, j), coefficient in zip(pairs, coefficients[:, 1 + count :].T, strict=True):
        hessian[:, i, j] += coefficient
        hessian[:, j, i] += coefficient
    convex = np.linalg.eigvalsh(hessian)[:, 0] > 1e-9
    invertible = np.where(convex[:, None, None], hessian, np.eye(count))
    minimum = -np.linalg.solve(invertible, coefficients[:, 1 : 1 + count, None])[..., 0]
    near = convex & (np.abs(minimum).max(1) < max_extrapolation)
    minimum = np.where(near[:, None], minimum, x[errors.argmin(1)])
    return centre + minimum @ axes.T, np.diagonal(inverse.T @ hessian @ inverse, axis1=1, axis2=2)


def parabola_minimum(
    grid: Float[np.ndarray, " candidates"], errors: Float[np.ndarray, "resamples candidates"]
) -> Float[np.ndarray, " resamples"]:
    """Find the minima of the parabolas through the best candidate and its two neighbours.

    `quadratic_minimum` averages the noise of all candidates, but misses a minimum that is narrower than the grid. This
    function is for coarse grids of one quantity.

    Args:
        grid: evenly spaced candidates, at least three.
        errors: one set of errors for each weighting.

    Returns:
        The minima, at most one step of the grid from the best candidate.
    """
    lowest = errors.argmin(1).clip(1, len(grid) - 2)
    before, at, after = (errors[np.arange(len(errors)), lowest + offset] for offset in (-1, 0, 1))
    curvature = before - 2 * at + after
    offset = 0.5 * (before - after) / np.where(curvature > 0, curvature, 1)
    offset = np.where(curvature > 0, offset.clip(-1, 1), np.sign(before - after))
    return grid[lowest] + offset * (grid[1] - grid[0])
