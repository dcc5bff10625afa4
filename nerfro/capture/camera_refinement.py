"""Cameras and hull in turns, each made of the other, until the hull is seen in its masks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from nerfro.camera.panorama import align
from nerfro.camera.pixel_units import object_distances
from nerfro.camera.refined import RefinedCamera
from nerfro.camera.similarity import motion_between
from nerfro.capture.outlines import meet_outlines
from nerfro.capture.surface import object_box
from nerfro.capture.visual_hull import Silhouettes
from nerfro.data.base import Views
from nerfro.data.pixel_store import PixelStore
from nerfro.errors import NerfroError
from nerfro.geometry.interpolation import misses
from nerfro.geometry.mesh import TriangleMesh

_VOXELS = 64  # along the hull's longest side, while cameras move
_ROUNDS, _SETTLED = 10, 0.02  # at most; it ends when cameras move by fewer pixels


def refine_cameras(
    views: Views,
    silhouettes: Silhouettes,
    wrong_masks: int,
    surface: TriangleMesh | Callable[[Silhouettes, int], TriangleMesh],
) -> RefinedCamera:
    """Turn cameras by the sky, then move them until the surface is seen in its masks; print how far.

    A turn and a shift of a camera move a small object alike. What is far away tells them apart, so it must be seen.

    Args:
        views: photographs with poses.
        silhouettes: of the same views.
        wrong_masks: see `object_box`.
        surface: that is known, or makes the hull of masks with so many voxels along its longest side.

    Raises:
        NerfroError: no two photographs show the same of what is far away.
    """
    camera = RefinedCamera()
    camera.begin(views.cameras)
    colours, box = PixelStore(views.images), torch.from_numpy(object_box(silhouettes, wrong_masks)).float()
    panorama = align(camera, views.cameras, lambda pixels: colours[pixels], lambda rays: misses(box, rays))
    if panorama is None:
        raise NerfroError(
            "refine_cameras=true: no two photographs show the same surroundings beside the object, and these tell how "
            "cameras are turned; leave it out"
        )
    motions = camera.motions
    for _ in range(1 if isinstance(surface, TriangleMesh) else _ROUNDS):
        mesh, before = surface, motions.held()
        if not isinstance(mesh, TriangleMesh):
            mesh = mesh(replace(silhouettes, cameras=camera.believed(views.cameras)), _VOXELS)
        # The first hulls are no better than the poses, and far off their masks.
        meet_outlines(camera, views.cameras, lambda cameras: cameras, silhouettes, mesh, [panorama], math.inf)
        if float(((motions.held() - before) / motions.units).square().sum(-1).mean().sqrt()) < _SETTLED:
            break
    turned, shifted = motion_between(views.cameras.camera_to_world, camera.believed(views.cameras).camera_to_world)
    share = float((shifted / object_distances(views.cameras)).median())
    print(
        f"cameras refined: turned by {turned.median():.2g} degrees, shifted by {share:.2%} of their distance (medians)"
    )
    return camera
