"""Compositing of projected Gaussians on the CPU, with gradients.

Source: B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023, Eqn. 3. The
colour of a pixel is C = sum_i c_i alpha_i T_i with T_i = prod_{j<i} (1 - alpha_j) from front to back, where alpha_i is
the opacity times the value of the projected Gaussian at the pixel. As in the paper's implementation, alpha is at most
0.99, values below 1/255 are left out, and so is what lies behind a transmittance of 1e-4.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor

from nerfro.kernels.compilation import compiled, compiled_parallel

_BANDS = 8  # of rows; a fixed number, so that sums of gradients do not depend on the number of threads
_MAX_ALPHA, _MIN_ALPHA, _MIN_TRANSMITTANCE = 0.99, 1 / 255, 1e-4


def rasterize(splats: Float[Tensor, "N 9"], height: int, width: int) -> Float[Tensor, "H W 3"]:
    """Composite Gaussians over black, differentiable with respect to the Gaussians.

    Args:
        splats: Gaussians from front to back: mean (x, y) in pixels, where pixel (row i, column j) has its centre at
            (j + .5, i + .5); entries (xx, xy, yy) of the inverse covariance; opacity; and colour.
        height, width: size of the image, pixels.
    """
    return _Rasterize.apply(splats, height, width)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, splats: Tensor, height: int, width: int) -> Tensor:
        splats = splats.detach().contiguous()
        image = splats.new_zeros(height, width, 3)
        _composite(splats.numpy(), image.numpy())
        ctx.save_for_backward(splats, image)
        return image

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        splats, image = ctx.saved_tensors
        of_splats = splats.new_zeros(_BANDS, *splats.shape)
        _composite_backward(splats.numpy(), image.numpy(), gradient.contiguous().numpy(), of_splats.numpy())
        return of_splats.sum(0), None, None


@compiled
def _pixels(splat, first, last, width):
    """Return the rows, of a band, and the columns in which alpha may reach its lower limit."""
    x, y, xx, xy, yy = splat[0], splat[1], splat[2], splat[3], splat[4]
    reach = math.sqrt(2 * max(math.log(splat[5] / _MIN_ALPHA), 0.0) / (xx * yy - xy * xy))
    half_width, half_height = reach * math.sqrt(yy), reach * math.sqrt(xx)
    if y + half_height < first or y - half_height > last or x + half_width < 0 or x - half_width > width:
        return 0, 0, 0, 0
    top, bottom = max(first, math.ceil(y - half_height - 0.5)), min(last, math.floor(y + half_height + 0.5))
    left, right = max(0, math.ceil(x - half_width - 0.5)), min(width, math.floor(x + half_width + 0.5))
    return top, bottom, left, right


@compiled
def _falloff(splat, row, column):
    """Return the offset of a pixel from the mean, and the value of the Gaussian there, at most 1."""
    half = splat.dtype.type(0.5)
    dx, dy = column + half - splat[0], row + half - splat[1]
    return dx, dy, math.exp(-half * (splat[2] * dx * dx + splat[4] * dy * dy) - splat[3] * dx * dy)


@compiled_parallel
def _composite(splats, image):
    height, width = image.shape[:2]
    for band in prange(_BANDS):
        first, last = height * band // _BANDS, height * (band + 1) // _BANDS
        transmittance = np.ones((last - first, width), splats.dtype)
        for i in range(len(splats)):
            splat = splats[i]
            top, bottom, left, right = _pixels(splat, first, last, width)
            for row in range(top, bottom):
                for column in range(left, right):
                    t = transmittance[row - first, column]
                    if t < _MIN_TRANSMITTANCE:
                        continue
                    alpha = splat[5] * _falloff(splat, row, column)[2]
                    if alpha < _MIN_ALPHA:
                        continue
                    alpha = min(alpha, _MAX_ALPHA)
                    for c in range(3):
                        image[row, column, c] += t * alpha * splat[6 + c]
                    transmittance[row - first, column] = t * (1 - alpha)


@compiled_parallel
def _composite_backward(splats, image, gradient, of_splats):
    """Add the gradient of the Gaussians in each band of rows.

    With the gradient g of a pixel, and the colour B_i that the Gaussians behind number i add to the pixel,
    d(g . C) / d alpha_i = T_i g . c_i - g . B_i / (1 - alpha_i). From front to back, g . B_i is what remains of g . C.
    """
    height, width = image.shape[:2]
    for band in prange(_BANDS):
        first, last = height * band // _BANDS, height * (band + 1) // _BANDS
        transmittance = np.ones((last - first, width), splats.dtype)
        remaining = (gradient[first:last] * image[first:last]).sum(-1)
        for i in range(len(splats)):
            splat = splats[i]
            top, bottom, left, right = _pixels(splat, first, last, width)
            of_splat = of_splats[band, i]
            for row in range(top, bottom):
                for column in range(left, right):
                    t = transmittance[row - first, column]
                    if t < _MIN_TRANSMITTANCE:
                        continue
                    dx, dy, falloff = _falloff(splat, row, column)
                    alpha = splat[5] * falloff
                    if alpha < _MIN_ALPHA:
                        continue
                    clipped = min(alpha, _MAX_ALPHA)
                    of_colour = 0.0
                    for c in range(3):
                        of_colour += gradient[row, column, c] * splat[6 + c]
                        of_splat[6 + c] += t * clipped * gradient[row, column, c]
                    remaining[row - first, column] -= t * clipped * of_colour
                    transmittance[row - first, column] = t * (1 - clipped)
                    if alpha > _MAX_ALPHA:
                        continue
                    of_alpha = t * of_colour - remaining[row - first, column] / (1 - alpha)
                    of_power = of_alpha * alpha
                    of_splat[0] += of_power * (splat[2] * dx + splat[3] * dy)
                    of_splat[1] += of_power * (splat[4] * dy + splat[3] * dx)
                    of_splat[2] -= of_power * 0.5 * dx * dx
                    of_splat[3] -= of_power * dx * dy
                    of_splat[4] -= of_power * 0.5 * dy * dy
                    of_splat[5] += of_alpha * falloff
