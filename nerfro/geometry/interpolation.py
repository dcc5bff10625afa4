"""Interpolation and smoothing on regular grids whose outer vertices lie on the box."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.rays import Rays
from nerfro.kernels.constants import constant


def trilinear(
    table: Float[Tensor, "X Y Z C"], box: Float[Tensor, "2 3"], positions: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch C"]:
    """Interpolate all channels of a grid trilinearly; positions outside get the values at the border.

    Args:
        table: values at the vertices.
        box: lower and upper corner of the grid, world units.
        positions: world units.
    """
    shape = constant(table.shape[:3], table.device)
    scale = (shape - 1) / (box[1] - box[0])
    coordinates = ((positions - box[0]) * scale).reshape(-1, 3)
    coordinates = torch.minimum(coordinates.clamp(min=0), (shape - 1).to(coordinates))
    cell = torch.minimum(coordinates.long(), shape - 2)
    fraction = (coordinates - cell)[..., None]
    flat = table.reshape(-1, table.shape[-1])
    stride_x, stride_y = table.shape[1] * table.shape[2], table.shape[2]
    corner = cell[:, 0] * stride_x + cell[:, 1] * stride_y + cell[:, 2]
    fx, fy, fz = fraction.unbind(1)

    def along_z(start: Tensor) -> Tensor:
        return torch.lerp(flat[start], flat[start + 1], fz)

    def along_y(start: Tensor) -> Tensor:
        return torch.lerp(along_z(start), along_z(start + stride_y), fy)

    values = torch.lerp(along_y(corner), along_y(corner + stride_x), fx)
    return values.reshape(*positions.shape[:-1], table.shape[-1])


def intersect_box(
    box: Float[Tensor, "2 3"], origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]
) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
    """Return the distances at which lines enter and leave a box, differentiable; enter > leave for lines that miss."""
    # A line parallel to a slab is inside or outside everywhere. Division by zero would make the gradients nan.
    parallel = directions == 0
    inverse = 1.0 / torch.where(parallel, 1.0, directions)
    below, above = box[0] - origins, box[1] - origins
    missed = (below > 0) | (above < 0)
    to_low, to_high = below * inverse, above * inverse
    enter = torch.where(parallel, torch.where(missed, torch.inf, -torch.inf), torch.minimum(to_low, to_high)).amax(-1)
    leave = torch.where(parallel, torch.where(missed, -torch.inf, torch.inf), torch.maximum(to_low, to_high)).amin(-1)
    return enter, leave


def misses(box: Float[Tensor, "2 3"], rays: Rays) -> Bool[Tensor, "R"]:
    """Return which rays miss a box."""
    enter, leave = intersect_box(box, rays.origins, rays.directions)
    return (enter >= leave) | (leave <= 0)


def spline_coefficients(values: Float[Tensor, "X Y Z"]) -> Float[Tensor, "X Y Z"]:
    """Return coefficients of a quadratic B-spline that interpolates smooth values to fourth order in the spacing.

    c = f - f'' / 8 along each axis, with the second difference f''. The exact inverse has infinite support and rings
    at creases, whereas this approximation has three taps.
    """
    for axis in range(3):
        before, after = neighbours(values, axis)
        values = 1.25 * values - 0.125 * (before + after)
    return values.contiguous()


def quadratic_spline(
    coefficients: Float[Tensor, "X Y Z"], box: Float[Tensor, "2 3"], positions: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Evaluate a quadratic B-spline on a grid and its exact, continuous gradient; clamped near the border.

    Args:
        coefficients: at the vertices of the grid, see `spline_coefficients`.
        box: lower and upper corner of the grid, world units.
        positions: world units.
    """
    shape = constant(coefficients.shape, coefficients.device)
    scale = (shape - 1) / (box[1] - box[0])
    coordinates = ((positions - box[0]) * scale).reshape(-1, 3)
    centre = torch.minimum((coordinates + 0.5).floor().long().clamp(min=1), shape - 2)
    t = (coordinates - centre).clamp(-1.5, 1.5)
    weights = torch.stack([0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2], -1)
    slopes = torch.stack([t - 0.5, -2 * t, t + 0.5], -1) * scale[:, None].to(t)
    taps = torch.arange(-1, 2, device=coefficients.device)
    stride = (coefficients.shape[1] * coefficients.shape[2], coefficients.shape[2], 1)
    rows = [(centre[:, axis, None] + taps) * stride[axis] for axis in range(3)]
    block = coefficients.reshape(-1)[rows[0][:, :, None, None] + rows[1][:, None, :, None] + rows[2][:, None, None, :]]
    along_z = torch.stack([(block * w[:, None, None, 2]).sum(-1) for w in (weights, slopes)], 1)
    plane = (along_z[:, 0] * weights[:, None, 1]).sum(-1)
    plane_y = (along_z[:, 0] * slopes[:, None, 1]).sum(-1)
    plane_z = (along_z[:, 1] * weights[:, None, 1]).sum(-1)
    value = (plane * weights[:, 0]).sum(-1)
    gradient = [(plane * slopes[:, 0]).sum(-1), *((p * weights[:, 0]).sum(-1) for p in (plane_y, plane_z))]
    return value.reshape(positions.shape[:-1]), torch.stack(gradient, -1).reshape(positions.shape)


def bspline_basis(num_control: int, num_places: int) -> Float[Tensor, "num_places num_control"]:
    """Return cubic B-splines of evenly spaced control points, evaluated from the second to the last but one."""
    from scipy.interpolate import BSpline  # takes a quarter of a second

    positions = np.linspace(1, num_control - 2, num_places)
    spline = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)  # NaN outside the knots
    return torch.from_numpy(np.nan_to_num(spline(positions[:, None] - np.arange(num_control)))).float()


def smooth(values: Float[Tensor, "X Y Z *C"], size: int, sigma: float) -> Float[Tensor, "X Y Z *C"]:
    """Convolve a grid with a normalized Gaussian of size^3 taps and replicated borders; size 0 changes nothing.

    Raises:
        NerfroError: the size is even or negative, or sigma is not positive.
    """
    if size == 0:
        return values
    if size < 0 or size % 2 == 0 or not sigma > 0:
        raise NerfroError(
            f"smoothing_size={size}, smoothing_sigma={sigma} is not a valid kernel; "
            "the size must be odd (or 0 for no smoothing) and sigma positive"
        )
    smoothed = scipy.ndimage.gaussian_filter(
        values.detach().cpu().numpy(), sigma, mode="nearest", radius=size // 2, axes=(0, 1, 2)
    )
    return torch.from_numpy(smoothed).to(values)


def neighbours(values: Float[Tensor, "X Y Z"], axis: int) -> tuple[Float[Tensor, "X Y Z"], Float[Tensor, "X Y Z"]]:
    """Return the values at the previous and at the next vertex along an axis, with replicated borders."""
    index = torch.arange(values.shape[axis], device=values.device)
    last = values.shape[axis] - 1
    return values.index_select(axis, (index - 1).clamp(min=0)), values.index_select(axis, (index + 1).clamp(max=last))
