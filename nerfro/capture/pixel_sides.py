"""What binary masks tell of an outline: on which side of it the centre of each pixel is."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import log_ndtr

from nerfro.capture.rims import Rims
from nerfro.capture.visual_hull import Silhouettes

# Of the pixels around a rim, those of a square of so many a side; farther along the outline they count less, by a
# normal distribution of this standard deviation, pixels: it bends away from the rim's tangent.
_SIDE, _ALONG = 4, 0.7
# The probit's standard deviation, in what an outline that is read off the masks is off by.
_SOFTNESS = 0.3
# Less is known of a rim that no pixel's centre is near to; the step to where its pixels want it goes so far at most.
_LEAST, _LONGEST = 1e-3, 0.5


def by_pixel_sides(rims: Rims, points: Float[np.ndarray, "K 3"], silhouettes: Silhouettes, off: float) -> Rims:
    """Rims whose misfits and weights come from the sides of the pixels around them alone.

    An outline that is read off a binary mask is off by 0.15 pixels, alike along whole stretches. What the mask says for
    certain is which centres are inside. A surface that stands for the whole object makes much of that: its outline
    passes between the centres of all views. A centre that is s inside an outline is inside the object with the
    probability Phi(s / sigma); one step of Newton's method on its logarithm gives misfit and weight.

    The outline that was read still tells which rims are outlines at all: those that are farther from it than most
    belong to waves of the surface behind others, and weigh less.

    Args:
        rims: of the surface, see `find_rims`.
        points: where they are.
        silhouettes: of binary masks.
        off: what outlines are off by, mean, pixels: sigma follows it.
    """
    sigma = _SOFTNESS * off
    slope, bend = np.zeros(len(points)), np.zeros(len(points))
    around = np.stack(np.meshgrid(*2 * [np.arange(_SIDE) - _SIDE // 2 + 1]), -1).reshape(-1, 1, 2)
    for view in np.unique(rims.view):
        seen, inside = np.flatnonzero(rims.view == view), (silhouettes.masks[int(view)] > 0.5).numpy()
        camera = silhouettes.cameras.select([int(view)])
        # Cameras project in single precision: a place some pixels away tells the direction.
        outwards = points[seen] + _SIDE * rims.width[seen, None] * rims.normal[seen]
        place, beyond = (
            camera.project(torch.from_numpy(each).float())[0][0].double().numpy() for each in (points[seen], outwards)
        )
        normal = (beyond - place) / np.linalg.norm(beyond - place, axis=1, keepdims=True)
        pixel = np.floor(place - 0.5).astype(np.int64) + around
        held = pixel.clip(0, np.array(inside.shape[::-1]) - 1)
        known = (pixel == held).all(-1)
        column, row = np.moveaxis(held, -1, 0)
        offset = place - (pixel + 0.5)
        depth, along = (offset * normal).sum(-1), offset[..., 0] * normal[:, 1] - offset[..., 1] * normal[:, 0]
        side = np.where(inside[row, column], 1.0, -1.0)
        weight = known * np.exp(-0.5 * (along / _ALONG) ** 2)
        sure = side * depth / sigma
        hazard = np.exp(-0.5 * (sure**2 + np.log(2 * np.pi)) - log_ndtr(sure))
        slope[seen] = sigma * (weight * side * hazard).sum(0)
        bend[seen] = (weight * hazard * (hazard + sure)).sum(0)
    misfit = (slope / bend.clip(_LEAST)).clip(-_LONGEST, _LONGEST)
    trusted = 1 / (1 + (rims.misfit / (off * rims.width)) ** 2)
    return rims._replace(misfit=misfit * rims.width, weight=trusted * bend / _SOFTNESS**2)
