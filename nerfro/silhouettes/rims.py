"""Contour points of a surface as seen from the cameras, and their distances to the outlines of the masks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.normals import unit
from nerfro.silhouettes.moving_mesh import MeshGeometry
from nerfro.silhouettes.visual_hull import Silhouettes

# By view: the index of the outline pixel nearest to each pixel.
Outlines: TypeAlias = "dict[int, Int[np.ndarray, 'H W']]"


@dataclass(frozen=True)
class RimSettings(AlgorithmSettings):
    """Settings of the misfits of contour points (`find_rims`).

    The median misfit relative to `mask_accuracy` scales the limits `max_misfit` and `half_weight`, so that a surface
    far from the masks keeps its observations.

    Attributes:
        mask_accuracy: accuracy of the outline of a binary mask, in pixels.
        max_misfit: largest misfit in pixels, beyond which a contour belongs to a fold of the surface in front of
            itself.
        half_weight: misfit in pixels at which the weight of an observation is one half.
        min_scale: smallest scale of `half_weight`, reached with antialiased masks.
    """

    mask_accuracy: float = 0.35
    max_misfit: float = 3.0
    half_weight: float = 0.7
    min_scale: float = 0.3


class Rims(NamedTuple):
    """Contour points on edges (first, second) of a mesh, at a fraction of the way from first to second.

    The surface meets the outline of the mask if it moves by `misfit` along `normal`.
    """

    first: Int[np.ndarray, " contour"]
    second: Int[np.ndarray, " contour"]
    fraction: Float[np.ndarray, " contour"]
    points: Float[np.ndarray, "contour 3"]  # positions of the contour points
    normal: Float[np.ndarray, "contour 3"]  # unit, outwards, perpendicular to the line of sight
    misfit: Float[np.ndarray, " contour"]  # outward distance to the outline of the mask, world units
    weight: Float[np.ndarray, " contour"]  # robust weight of the misfit
    width: Float[np.ndarray, " contour"]  # width of a pixel at the point, world units
    view: Int[np.ndarray, " contour"]


def outlines_of(silhouettes: Silhouettes) -> Outlines:
    """Compute the nearest outline pixels of all views."""
    return {view: _nearest_outline_pixel(mask) for view, mask in enumerate((silhouettes.masks > 0.5).numpy())}


def find_rims(
    surface: MeshGeometry, silhouettes: Silhouettes, outlines: Outlines, settings: RimSettings = RimSettings()
) -> Rims:
    """Find the outermost contour point near each pixel of the outlines of the masks.

    On a smooth surface, the contour crosses edges of the mesh along which the vertex normals turn away from the camera.
    On a sharp edge, the contour follows the edge if the camera sees only one of its sides.

    Raises:
        NerfroError: no view sees the surface.
    """
    settings.use()
    cameras, vertices = silhouettes.cameras, surface.vertices
    ends = vertices[surface.edges]
    spacing = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
    parts = []
    for view, outline in outlines.items():
        eye = cameras.camera_to_world[view, :, 3].double().numpy()
        first, second, fraction, normal = _turning(surface, eye)
        points = vertices[first] + fraction[:, None] * (vertices[second] - vertices[first])
        positions = torch.from_numpy(points).float()
        inside, width = (values.double().numpy() for values in silhouettes.depth_inside(view, positions))
        visible = np.flatnonzero(np.isfinite(inside))
        if not len(visible):
            continue
        # Pixels narrower than the edges of the mesh are grouped, or some would only contain contours of folds.
        pixels = max(1, int(np.ceil(spacing / width[visible].mean())))
        cell = _look_up(outline, cameras.select([view]), positions[visible], pixels)
        order = np.lexsort((inside[visible], cell))
        outermost = visible[order[np.diff(cell[order], prepend=-1) != 0]]
        of_view = np.full(len(outermost), view)
        of_points = (first, second, fraction, points, normal, inside, width)
        parts.append((*(values[outermost] for values in of_points), of_view))
    if not parts:
        raise NerfroError("no view sees the surface; check that surface, poses and masks belong together")
    *edges, misfit, width, views = (np.concatenate(values) for values in zip(*parts, strict=True))
    spread = float(np.median(np.abs(misfit))) / settings.mask_accuracy
    near = np.abs(misfit) < settings.max_misfit * max(1.0, spread)
    weight = 1 / (1 + (misfit / (settings.half_weight * max(settings.min_scale, spread))) ** 2)
    return Rims(*(values[near] for values in (*edges, misfit * width, weight, width, views)))


def _turning(
    surface: MeshGeometry, eye: Float[np.ndarray, "3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find the contour of a surface seen from a point: ends of edges, fractions along the edges, and normals."""
    vertices, edges, normals, creases, beside = surface
    facing = (normals * (vertices - eye)).sum(1)[edges]
    smooth = np.flatnonzero((facing[:, 0] > 0) != (facing[:, 1] > 0))
    fractions = facing[smooth, 0] / (facing[smooth, 0] - facing[smooth, 1])
    away = (beside * (vertices[creases[:, 0]] - eye)[:, None]).sum(-1) > 0
    sharp = creases[away[:, 0] != away[:, 1]]

    (first, second), fraction = np.r_[edges[smooth], sharp].T, np.r_[fractions, np.full(len(sharp), 0.5)]
    along = vertices[second] - vertices[first]
    look = unit(vertices[first] + fraction[:, None] * along - eye)
    normal = (1 - fraction[:, None]) * normals[first] + fraction[:, None] * normals[second]
    # Only the motion of a sharp edge perpendicular to itself is visible, whatever the normals of the adjacent sides.
    across = np.cross(look, along)
    across *= np.sign((across * normal).sum(1, keepdims=True))
    normal -= (normal * look).sum(1, keepdims=True) * look
    normal[len(smooth) :] = across[len(smooth) :]
    return first, second, fraction, unit(normal)


def _look_up(
    outline: Int[np.ndarray, "H W"], camera: Cameras, points: Tensor, pixels: int
) -> Int[np.ndarray, " points"]:
    """Return the index of the block of pixels x pixels that contains the outline pixel nearest to each point."""
    position = camera.project(points)[0][0].numpy()
    row = position[:, 1].astype(np.int64).clip(0, camera.height - 1)
    column = position[:, 0].astype(np.int64).clip(0, camera.width - 1)
    nearest = outline[row, column]
    return nearest // camera.width // pixels * camera.width + nearest % camera.width // pixels


def _nearest_outline_pixel(inside: np.ndarray) -> Int[np.ndarray, "H W"]:
    """Return the index of the outline pixel of a mask nearest to each pixel."""
    outline = inside & ~scipy.ndimage.binary_erosion(inside, border_value=1)
    rows, columns = scipy.ndimage.distance_transform_edt(~outline, return_distances=False, return_indices=True)
    return rows * inside.shape[1] + columns


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
        hazard = np.exp(-0.5 * (margin**2 + np.log(2 * np.pi)) - scipy.special.log_ndtr(margin))
        gradient[of_view] = sigma * (weight * side * hazard).sum(0)
        curvature[of_view] = (weight * hazard * (hazard + margin)).sum(0)
    misfit = (gradient / curvature.clip(settings.min_second_derivative)).clip(-settings.max_step, settings.max_step)
    trust = 1 / (1 + (rims.misfit / (error * rims.width)) ** 2)
    return rims._replace(misfit=misfit * rims.width, weight=trust * curvature / settings.softness**2)
