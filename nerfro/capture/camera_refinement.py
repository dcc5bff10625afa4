"""Cameras and hull in turns, each made of the other, until the hull is seen in its masks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from nerfro.camera.outlines import FARTHEST, meet_outlines
from nerfro.camera.panorama import align
from nerfro.camera.pixel_units import object_distances
from nerfro.camera.refined import RefinedCamera
from nerfro.camera.similarity import motion_between
from nerfro.capture.visual_hull import Silhouettes, find_box
from nerfro.data.base import Views
from nerfro.data.pixel_store import PixelStore
from nerfro.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh
from nerfro.rays import misses

ROUGH_VOXELS = 64  # along the hull's longest side, while cameras move
_ROUNDS = 4


def refine_cameras(
    views: Views,
    silhouettes: Silhouettes,
    wrong_masks: int,
    surface: TriangleMesh | Callable[[Silhouettes], TriangleMesh],
) -> RefinedCamera:
    """Turn cameras by the sky, then move them until the surface is seen in its masks; print how far.

    A turn and a shift of a camera move a small object alike. What is far away tells them apart, so it must be seen.

    Args:
        views: photographs with poses.
        silhouettes: of the same views.
        wrong_masks: see `find_box`.
        surface: that is known, or makes the hull of masks.

    Raises:
        NerfroError: no two photographs show the same of what is far away, or the surface does not come near its masks.
    """
    camera = RefinedCamera()
    camera.begin(views.cameras)
    colours, box = PixelStore(views.images), torch.from_numpy(find_box(silhouettes, wrong_masks)).float()
    panorama = align(camera, views.cameras, lambda pixels: colours[pixels], lambda rays: misses(box, rays))
    if panorama is None:
        raise NerfroError(
            "refine_cameras=true: no two photographs show the same surroundings beside the object, and these tell how "
            "cameras are turned; leave it out"
        )
    for left in reversed(range(_ROUNDS)):
        mesh = surface
        if not isinstance(mesh, TriangleMesh):
            mesh = mesh(replace(silhouettes, cameras=camera.believed(views.cameras)))
        farthest = math.inf if left else FARTHEST  # the first hulls are no better than the poses
        if not meet_outlines(camera, views.cameras, lambda cameras: cameras, silhouettes, mesh, [panorama], farthest):
            raise NerfroError(
                "refine_cameras=true: the surface does not come near its masks; correct the masks, or leave it "
                "out where the surroundings are near"
            )
    turned, shifted = motion_between(views.cameras.camera_to_world, camera.believed(views.cameras).camera_to_world)
    share = float((shifted / object_distances(views.cameras)).median())
    print(
        f"cameras refined: turned by {turned.median():.2g} degrees, shifted by {share:.2%} of their distance (medians)"
    )
    return camera
