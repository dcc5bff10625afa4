"""Observation model of binary masks: whether each pixel centre is inside or outside the outline."""

from __future__ import annotations

import numpy as np
import torch
from scipy.special import log_ndtr

from nerfro.silhouettes.rims import Rims
from nerfro.silhouettes.visual_hull import Silhouettes

# Side, in pixels, of the square of pixels around a contour point, and standard deviation, in pixels, of the Gaussian
# weight along the outline, which curves away from the tangent.
_SIDE, _ALONG = 4, 0.7
# Standard deviation of the probit model, relative to the mean error of the outline.
_SOFTNESS = 0.3
# Smallest second derivative in the Newton step, and longest step in pixels.
_MIN_SECOND_DERIVATIVE, _MAX_STEP = 1e-3, 0.5


def by_pixel_sides(rims: Rims, silhouettes: Silhouettes, error: float) -> Rims:
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
    """
    sigma, points = _SOFTNESS * error, rims.points
    gradient, curvature = np.zeros(len(points)), np.zeros(len(points))
    neighbours = np.stack(np.meshgrid(*2 * [np.arange(_SIDE) - _SIDE // 2 + 1]), -1).reshape(-1, 1, 2)
    for view in np.unique(rims.view):
        chosen, inside = np.flatnonzero(rims.view == view), (silhouettes.masks[int(view)] > 0.5).numpy()
        camera = silhouettes.cameras.select([int(view)])
        # Projection has single precision, so the image normal is computed from a point some pixels away.
        outwards = points[chosen] + _SIDE * rims.width[chosen, None] * rims.normal[chosen]
        place, beyond = (
            camera.project(torch.from_numpy(each).float())[0][0].double().numpy() for each in (points[chosen], outwards)
        )
        normal = (beyond - place) / np.linalg.norm(beyond - place, axis=1, keepdims=True)
        pixel = np.floor(place - 0.5).astype(np.int64) + neighbours
        inner = pixel.clip(0, np.array(inside.shape[::-1]) - 1)
        known = (pixel == inner).all(-1)
        column, row = np.moveaxis(inner, -1, 0)
        offset = place - (pixel + 0.5)
        depth, along = (offset * normal).sum(-1), offset[..., 0] * normal[:, 1] - offset[..., 1] * normal[:, 0]
        side = np.where(inside[row, column], 1.0, -1.0)
        weight = known * np.exp(-0.5 * (along / _ALONG) ** 2)
        margin = side * depth / sigma
        hazard = np.exp(-0.5 * (margin**2 + np.log(2 * np.pi)) - log_ndtr(margin))
        gradient[chosen] = sigma * (weight * side * hazard).sum(0)
        curvature[chosen] = (weight * hazard * (hazard + margin)).sum(0)
    misfit = (gradient / curvature.clip(_MIN_SECOND_DERIVATIVE)).clip(-_MAX_STEP, _MAX_STEP)
    trust = 1 / (1 + (rims.misfit / (error * rims.width)) ** 2)
    return rims._replace(misfit=misfit * rims.width, weight=trust * curvature / _SOFTNESS**2)
