"""Observation model of binary masks: whether each pixel centre is inside or outside the outline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import log_ndtr

from nerfro.core.provenance import AlgorithmSettings
from nerfro.silhouettes.rims import Rims
from nerfro.silhouettes.visual_hull import Silhouettes


@dataclass(frozen=True)
class PixelSideSettings(AlgorithmSettings):
    """Settings of the probit model of binary masks (`by_pixel_sides`).

    Attributes:
        side: side of the square of pixels around a contour point, in pixels.
        along: standard deviation of the Gaussian weight along the outline, which curves away from the tangent, in
            pixels.
        softness: standard deviation of the model, relative to the mean error of the outline.
        min_second_derivative: smallest second derivative in the Newton step.
        max_step: longest Newton step, in pixels.
    """

    side: int = 4
    along: float = 0.7
    softness: float = 0.3
    min_second_derivative: float = 1e-3
    max_step: float = 0.5


def by_pixel_sides(
    rims: Rims, silhouettes: Silhouettes, error: float, settings: PixelSideSettings = PixelSideSettings()
) -> Rims:
    """Replace misfits and weights of contour points by those of a probit model of the surrounding pixels.

    The outline that is interpolated from a binary mask has an error of 0.15 pixels, which is correlated along the
    outline. The mask states exactly, however, which pixel centres are inside. In the probit model, a pixel centre at
    the depth s inside the contour belongs to the object with probability Phi(s / sigma). One Newton step on the log
    likelihood gives misfit and weight.

    The distance to the interpolated outline still reduces the weight of contour points far from the outline, because
    such points belong to folds of the surface behind other parts.

    Args:
        rims: contour points of the surface (see `find_rims`).
        silhouettes: silhouettes of binary masks.
        error: mean error of the contours, in pixels; sigma is proportional to it.
        settings: settings of the model.
    """
    settings.use()
    sigma, points, square = settings.softness * error, rims.points, settings.side
    gradient, curvature = np.zeros(len(points)), np.zeros(len(points))
    neighbours = np.stack(np.meshgrid(*2 * [np.arange(square) - square // 2 + 1]), -1).reshape(-1, 1, 2)
    for view in np.unique(rims.view):
        of_view, inside = np.flatnonzero(rims.view == view), (silhouettes.masks[int(view)] > 0.5).numpy()
        camera = silhouettes.cameras.select([int(view)])
        # Projection has single precision, so the image normal is computed from a point some pixels away.
        outwards = points[of_view] + square * rims.width[of_view, None] * rims.normal[of_view]
        ends = (torch.from_numpy(end).float() for end in (points[of_view], outwards))
        centre, beyond = (camera.project(end)[0][0].double().numpy() for end in ends)
        normal = (beyond - centre) / np.linalg.norm(beyond - centre, axis=1, keepdims=True)
        pixel = np.floor(centre - 0.5).astype(np.int64) + neighbours
        inner = pixel.clip(0, np.array(inside.shape[::-1]) - 1)
        in_image = (pixel == inner).all(-1)
        column, row = np.moveaxis(inner, -1, 0)
        offset = centre - (pixel + 0.5)
        depth, along = (offset * normal).sum(-1), offset[..., 0] * normal[:, 1] - offset[..., 1] * normal[:, 0]
        side = np.where(inside[row, column], 1.0, -1.0)
        weight = in_image * np.exp(-0.5 * (along / settings.along) ** 2)
        margin = side * depth / sigma
        hazard = np.exp(-0.5 * (margin**2 + np.log(2 * np.pi)) - log_ndtr(margin))
        gradient[of_view] = sigma * (weight * side * hazard).sum(0)
        curvature[of_view] = (weight * hazard * (hazard + margin)).sum(0)
    misfit = (gradient / curvature.clip(settings.min_second_derivative)).clip(-settings.max_step, settings.max_step)
    trust = 1 / (1 + (rims.misfit / (error * rims.width)) ** 2)
    return rims._replace(misfit=misfit * rims.width, weight=trust * curvature / settings.softness**2)
