"""Alternating refinement of camera poses and visual hull."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from nerfro.camera.panorama import align
from nerfro.camera.pixel_units import object_distances
from nerfro.camera.refined import RefinedCamera
from nerfro.camera.similarity import motion_between
from nerfro.capture.outlines import align_to_outlines
from nerfro.capture.surface import object_box
from nerfro.capture.visual_hull import Silhouettes
from nerfro.data.base import Views
from nerfro.data.pixel_store import PixelStore
from nerfro.errors import NerfroError
from nerfro.geometry.interpolation import misses
from nerfro.geometry.mesh import TriangleMesh

_VOXELS = 64  # voxels along the longest side of the intermediate hulls
_ROUNDS, _CONVERGED = 10, 0.02  # maximum number of rounds, and root mean square motion in pixels that ends them


def refine_cameras(
    views: Views,
    silhouettes: Silhouettes,
    wrong_masks: int,
    surface: TriangleMesh | Callable[[Silhouettes, int], TriangleMesh],
) -> RefinedCamera:
    """Refine rotations by the distant surroundings, then poses by the outlines of the surface.

    Rotation and translation of a camera move a small object alike in the image, so distant surroundings must be
    visible to separate them.

    Args:
        views: photographs with poses.
        silhouettes: silhouettes of the same views.
        wrong_masks: number of views that may be wrong about any point.
        surface: known surface, or a function that makes the hull of silhouettes with a number of voxels per side.

    Returns:
        The refined cameras; prints the median motion.

    Raises:
        NerfroError: no two photographs show the same distant surroundings.
    """
    camera = RefinedCamera()
    camera.begin(views.cameras)
    colours, box = PixelStore(views.images), torch.from_numpy(object_box(silhouettes, wrong_masks)).float()
    panorama = align(camera, views.cameras, lambda pixels: colours[pixels], lambda rays: misses(box, rays))
    if panorama is None:
        raise NerfroError(
            "refine_cameras=true needs photographs that show the same distant surroundings, which determine the "
            "rotations, and no two photographs do; remove the option"
        )
    motions = camera.motions
    for _ in range(1 if isinstance(surface, TriangleMesh) else _ROUNDS):
        mesh, before = surface, motions.fixed()
        if not isinstance(mesh, TriangleMesh):
            mesh = mesh(replace(silhouettes, cameras=camera.estimated(views.cameras)), _VOXELS)
        # The first hulls are as inaccurate as the poses, so any distance to the masks is accepted.
        align_to_outlines(camera, views.cameras, lambda cameras: cameras, silhouettes, mesh, [panorama], math.inf)
        if float(((motions.fixed() - before) / motions.units).square().sum(-1).mean().sqrt()) < _CONVERGED:
            break
    turned, shifted = motion_between(views.cameras.camera_to_world, camera.estimated(views.cameras).camera_to_world)
    relative = float((shifted / object_distances(views.cameras)).median())
    print(f"cameras refined: median rotation {turned.median():.2g} degrees, translation {relative:.2%} of the distance")
    return camera
