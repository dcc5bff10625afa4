"""Alignment of cameras by the outlines of the masks of a known surface.

Antialiased masks give outlines with an accuracy of hundredths of a pixel, and determine the pose of a camera more
accurately than colours do. However, outlines hardly distinguish a rotation from a translation across the line of sight;
the distant surroundings do (`panorama`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.camera.refined.gauss_newton import PriorInformation, normal_equations, shortened, with_priors
from nerfro.camera.refined.refined import RefinedCamera
from nerfro.core.cameras import Cameras
from nerfro.core.progress import track
from nerfro.core.provenance import AlgorithmSettings
from nerfro.data.base import Views
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.base import Medium
from nerfro.silhouettes.moving_mesh import MovingMesh
from nerfro.silhouettes.rims import Rims, find_rims, outlines_of
from nerfro.silhouettes.silhouettes import PixelBlocks
from nerfro.silhouettes.visual_hull import Silhouettes


@dataclass(frozen=True)
class OutlineSettings(AlgorithmSettings):
    """Settings of the alignment of cameras by the outlines of masks (`align_to_masks`).

    Attributes:
        max_pixels: largest side of the reduced images in which outlines are compared.
        steps: number of Gauss-Newton steps.
        max_step: longest step of a camera, in pixels.
        accuracy: accuracy of outlines, in pixels.
        correlated: number of neighbouring contour points with a common error.
        prior_deviation: standard deviation of the prior of each parameter, in pixels, which fixes parameters that
            outlines do not determine.
        max_distance: largest final distance between the surface and its masks, in pixels of the reduced masks;
            otherwise mesh and masks differ.
    """

    max_pixels: int = 256
    steps: int = 8
    max_step: float = 2.0
    accuracy: float = 0.02
    correlated: float = 3.0
    prior_deviation: float = 1.0
    max_distance: float = 0.2


def align_to_masks(
    camera: RefinedCamera,
    views: Views,
    medium: Medium,
    panorama: PriorInformation | None,
    settings: OutlineSettings = OutlineSettings(),
) -> PriorInformation | None:
    """Move cameras so that the outlines of the surface agree with the masks.

    Args:
        camera: estimated cameras; they are changed.
        views: training views.
        medium: medium with the surface.
        panorama: prior of the camera rotations from the background; None without a panorama.
        settings: steps and limits.

    Returns:
        Prior of the cameras from the outlines; None without masks or without a surface.
    """
    outline = medium.outline
    if outline is None or views.masks is None:
        return None
    blocks = PixelBlocks(views.cameras, settings.max_pixels)
    masks = torch.stack([blocks.mean(mask) for mask in views.masks])
    silhouettes = Silhouettes.of(blocks.cameras(views.cameras), masks)
    priors = [] if panorama is None else [panorama]
    return align_to_outlines(camera, views.cameras, silhouettes, outline, priors, settings)


@torch.no_grad()
def align_to_outlines(
    camera: RefinedCamera,
    cameras: Cameras,
    silhouettes: Silhouettes,
    mesh: TriangleMesh,
    priors: Sequence[PriorInformation] = (),
    settings: OutlineSettings = OutlineSettings(),
) -> PriorInformation | None:
    """Move the cameras until the contours of a surface meet the outlines of the masks.

    A common width by which all masks are too large or too small is eliminated.

    Args:
        camera: estimated cameras, changed in place.
        cameras: cameras of the data set.
        silhouettes: silhouettes of all views, downscaled to `settings.max_pixels` (see `PixelBlocks`).
        mesh: the surface.
        priors: prior information about the cameras.
        settings: steps and limits.

    Returns:
        The information that the outlines give about the cameras. None if the surface does not fit its masks; the
        cameras are then unchanged.
    """
    settings.use()
    initial = camera.parameter_vector()
    weak = PriorInformation(initial, torch.eye(len(initial)).to(initial) / settings.prior_deviation**2)
    blocks, outlines = PixelBlocks(cameras, settings.max_pixels), outlines_of(silhouettes)
    surface = MovingMesh(mesh.faces).geometry(mesh.vertices)
    for step in track("outlines", range(settings.steps + 1)):
        estimated = blocks.cameras(camera.estimated(cameras))
        rims = find_rims(surface, replace(silhouettes, cameras=estimated), outlines)
        slopes, error, weights, view = _observations(camera, cameras, estimated, rims)
        variance = float((weights * error[:, 0].square()).sum() / weights.sum()) + settings.accuracy**2
        if step < settings.steps:
            matrix, vector = normal_equations(slopes, error, weights, view, len(cameras))
            matrix, vector = _without_width(matrix, vector)
            parameters = camera.parameter_vector()
            matrix, vector = with_priors(matrix, vector, parameters, settings.correlated * variance, [*priors, weak])
            motion, lens = camera.split(-torch.linalg.solve(matrix, vector).to(camera.motion))
            camera.move(shortened(motion, settings.max_step), lens)
    distance = float((error - error.median()).abs().median())
    if distance > settings.max_distance:
        camera.restore(initial, torch.ones(len(cameras), dtype=torch.bool), lens=True)
        print(
            f"outlines: the surface is {distance:.2f} pixels off its masks (of at most {settings.max_pixels} pixels), "
            "so the cameras are not aligned"
        )
        return None
    matrix, vector = normal_equations(slopes, error, weights, view, len(cameras), damping=0.0)
    information = _without_width(matrix, vector)[0] / (settings.correlated * variance)
    return PriorInformation(camera.parameter_vector(), information.to(initial))


def _observations(
    camera: RefinedCamera, cameras: Cameras, estimated: Cameras, rims: Rims
) -> tuple[Float[Tensor, "R 1 M"], Float[Tensor, "R 1"], Float[Tensor, "R"], Int[Tensor, "R"]]:
    """Compute derivatives, errors, weights and views of the contour points, in pixels of the silhouettes.

    The last derivative is by the common width of the masks.

    Args:
        camera: estimated cameras.
        cameras: cameras of the data set.
        estimated: estimated cameras of the silhouettes.
        rims: contour points that these cameras see.
    """
    device, views = camera.motion.device, torch.from_numpy(rims.view)
    points, normals, misfits, weights, widths = (
        torch.from_numpy(values).float() for values in (rims.points, rims.normal, rims.misfit, rims.weight, rims.width)
    )
    of_views = points.split(torch.bincount(views, minlength=len(cameras)).tolist())
    position = torch.cat([estimated.select([view]).project(part)[0][0] for view, part in enumerate(of_views)])
    position = position * position.new_tensor([cameras.width / estimated.width, cameras.height / estimated.height])
    pixel = position.floor()
    rays = cameras.rays(views, pixel[:, 1], pixel[:, 0], position - pixel)
    # The ray of a fixed pixel that moves outwards misses the surface, as if the mask were larger.
    outwards = normals / widths[:, None]
    distances = (points - estimated.camera_to_world[views, :, 3]).norm(dim=-1, keepdim=True)
    views, by_origin, by_direction = (x.to(device) for x in (views, outwards, distances * outwards))
    slopes = camera.slopes(rays.to(device), views, by_origin[:, None], by_direction[:, None]).double()
    slopes = torch.cat([slopes, torch.ones_like(slopes[..., :1])], -1)
    return slopes, (misfits / widths).to(slopes)[:, None], weights.to(slopes), views


def _without_width(
    matrix: Float[Tensor, "parameters parameters"], vector: Float[Tensor, " parameters"]
) -> tuple[Float[Tensor, "parameters-1 parameters-1"], Float[Tensor, " parameters-1"]]:
    """Eliminate the last parameter from normal equations (Schur complement)."""
    column, last = matrix[:-1, -1], matrix[-1, -1]
    return matrix[:-1, :-1] - torch.outer(column, column) / last, vector[:-1] - column * (vector[-1] / last)
