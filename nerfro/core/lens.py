"""Lens distortion by the polynomial and rational models of OpenCV, COLMAP and nerfstudio, and the inverse."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

# Angles from the optical axis at which `fold_radius` searches, and the largest one in degrees.
_NUM_ANGLES, _MAX_ANGLE = 1024, 89.9


def coefficients(
    numerator: Sequence[float] = (), tangential: Sequence[float] = (), denominator: Sequence[float] = ()
) -> tuple[float, ...] | None:
    """Collect the nine coefficients for `distort`; returns None if all are zero.

    Args:
        numerator: up to four coefficients, of r^2, r^4, r^6 and r^8 (OpenCV's k1, k2, k3; nerfstudio's k1 to k4).
        tangential: p1 and p2, or none.
        denominator: up to three coefficients, of r^2, r^4 and r^6 (OpenCV's k4, k5, k6).
    """
    parts = ((numerator, 4), (tangential, 2), (denominator, 3))
    padded = [float(number) for part, size in parts for number in (*part, *[0.0] * (size - len(part)))]
    return tuple(padded) if any(padded) else None


def opencv_coefficients(numbers: Sequence[float]) -> tuple[float, ...] | None:
    """Convert 0, 4, 5 or 8 numbers in OpenCV's order k1, k2, p1, p2[, k3[, k4, k5, k6]] to `coefficients`."""
    k = numbers
    return coefficients([*k[:2], *k[4:5]], k[2:4], k[5:8])


def distort(
    points: Float[Tensor, "R 2"], lens: Float[Tensor, "R 9"]
) -> tuple[Float[Tensor, "R 2"], Float[Tensor, "R 3"]]:
    """Distort points of the ideal image plane at unit depth, x right and y down (OpenCV, calib3d).

    x' = x (1 + k1 r^2 + ...) / (1 + k4 r^2 + ...) + 2 p1 x y + p2 (r^2 + 2 x^2), and y' with p1 and p2 exchanged.

    Returns:
        Distorted points, and the derivatives dx'/dx, dx'/dy = dy'/dx and dy'/dy.
    """
    x, y = points.unbind(-1)
    k1, k2, k3, k4, p1, p2, q1, q2, q3 = lens.unbind(-1)
    r2 = x * x + y * y
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    below = 1 + r2 * (q1 + r2 * (q2 + r2 * q3))
    radial = above / below
    slope = k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)) - radial * (q1 + r2 * (2 * q2 + r2 * 3 * q3))
    slope = 2 * slope / below
    mixed = x * y * slope + 2 * (p1 * x + p2 * y)
    distorted = torch.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)], -1
    )
    derivatives = [radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, mixed]
    derivatives.append(radial + y * y * slope + 6 * p1 * y + 2 * p2 * x)
    return distorted, torch.stack(derivatives, -1)


def distort_without_fold(
    points: Float[Tensor, "V points 2"], lens: Float[Tensor, "V 9"]
) -> Float[Tensor, "V points 2"]:
    """Distort points at any angle from the optical axis, so that points outside of the image stay outside.

    Beyond some radius, polynomials move points inwards again, which no lens does. From this radius on, the displacement
    by the lens is constant. The radius is that of the radial terms, because tangential terms are small.

    Args:
        points: points of the ideal image plane of each view, see `distort`.
        lens: coefficients of each view.

    Returns:
        Distorted points.
    """
    radius = torch.linalg.vector_norm(points, dim=-1, keepdim=True)
    fold = fold_radius(lens)[:, None, None]
    # A large radius replaces infinity.
    inner = points * torch.where(radius > fold, fold.clamp(max=1e6) / radius.clamp(min=1e-12), 1.0)
    distorted, _ = distort(inner.flatten(0, 1), lens.repeat_interleave(points.shape[1], 0))
    return distorted.view_as(points) + (points - inner)


def fold_radius(lens: Float[Tensor, "V 9"]) -> Float[Tensor, "V"]:
    """Return the radius at unit depth from which on the distorted radius decreases; infinity if it always grows.

    Tangential terms are left out.
    """
    radius = torch.linspace(0, math.radians(_MAX_ANGLE), _NUM_ANGLES, dtype=torch.float64, device=lens.device).tan()
    radial = lens.double().clone()
    radial[:, 4:6] = 0
    points = torch.stack([radius, torch.zeros_like(radius)], -1).repeat(len(lens), 1)
    distorted = distort(points, radial.repeat_interleave(_NUM_ANGLES, 0))[0][:, 0].view(len(lens), _NUM_ANGLES)
    folds = ~(distorted.diff(dim=1) > 0)
    return torch.where(folds.any(1), radius[folds.to(torch.int8).argmax(1)], torch.inf).to(lens)


def undistort(
    points: Float[Tensor, "R 2"], lens: Float[Tensor, "R 9"]
) -> tuple[Float[Tensor, "R 2"], Float[Tensor, "R"]]:
    """Invert `distort` with Newton's method.

    Returns:
        Ideal points, and ideal area per unit of area in the distorted image. The area is negative, or the point is
        wrong, beyond the radius at which the lens model folds back.
    """
    ideal = points
    # Newton's method doubles the number of digits in each step; eight steps suffice for single precision.
    for _ in range(8):
        distorted, derivatives = distort(ideal, lens)
        xx, xy, yy = derivatives.unbind(-1)
        error = points - distorted
        step_x = yy * error[:, 0] - xy * error[:, 1]
        step_y = xx * error[:, 1] - xy * error[:, 0]
        step = torch.stack([step_x, step_y], -1) / (xx * yy - xy * xy)[:, None]
        ideal = ideal + step
        # The next step would be below single precision.
        if bool((step.abs() < 1e-5).all()):
            break
    xx, xy, yy = distort(ideal, lens)[1].unbind(-1)
    return ideal, 1 / (xx * yy - xy * xy)
