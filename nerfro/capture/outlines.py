"""Cameras moved until a known surface is seen in the outlines of its masks.

A mask of shares tells its outline to hundredths of a pixel, all around: more of where a camera stands than colours do.
It hardly tells a turn from a shift across the line of sight; that the sky tells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.camera.least_squares import PriorInformation, normal_equations, with_priors
from nerfro.camera.refined import RefinedCamera
from nerfro.cameras import Cameras
from nerfro.capture.rims import RimFinder
from nerfro.capture.visual_hull import Silhouettes
from nerfro.geometry.mesh import TriangleMesh
from nerfro.progress import track

_STEPS = 8
_LONGEST = 2.0  # pixels that a camera is moved in a step, at most
# Outlines are known no better than this, pixels; and errors of so many neighbours are one.
_LEAST, _ALIKE = 0.02, 3.0
# Cameras are off by about so many pixels, so that what outlines hardly tell stays.
_GIVEN = 1.0
# If the surface is still seen farther off its masks, pixels, it is not theirs, or they were drawn by hand.
_FARTHEST = 0.2


@torch.no_grad()
def meet_outlines(
    camera: RefinedCamera,
    cameras: Cameras,
    reduced: Callable[[Cameras], Cameras],
    silhouettes: Silhouettes,
    mesh: TriangleMesh,
    told: Sequence[PriorInformation] = (),
    farthest: float = _FARTHEST,
) -> PriorInformation | None:
    """Move the cameras until the outlines of a surface are those of its masks.

    Masks that are too wide everywhere, or too narrow, by the same part of a pixel, do not disturb.

    Args:
        camera: what is believed of the cameras; it is changed.
        cameras: as the data give them.
        reduced: makes the cameras of the silhouettes of these.
        silhouettes: of all views.
        mesh: the surface.
        told: what is known of the cameras already.
        farthest: how far off its masks the surface may be seen in the end, median, pixels.

    Returns:
        What the outlines tell of them; none where the surface is seen farther off. Then cameras stay.
    """
    before = camera.position()
    begun = camera.numbers()
    given = PriorInformation(begun, torch.eye(len(begun)).to(begun) / _GIVEN**2)
    finder = RimFinder(mesh, silhouettes)
    for step in track("outlines", range(_STEPS + 1)):
        slopes, error, weights, view = _seen(camera, cameras, reduced, finder)
        variance = float((weights * error[:, 0].square()).sum() / weights.sum()) + _LEAST**2
        if step < _STEPS:
            matrix, vector = normal_equations(slopes, error, weights, view, len(cameras))
            matrix, vector = _any_width(matrix, vector)
            matrix, vector = with_priors(matrix, vector, camera.numbers(), _ALIKE * variance, [*told, given])
            motion, lens = camera.split(-torch.linalg.solve(matrix, vector).to(camera.motions.motion))
            motion = motion * (_LONGEST / motion.norm(dim=-1, keepdim=True).clamp(min=_LONGEST))
            camera.move(motion, lens)
    off = float((error - error.median()).abs().median())
    if off > farthest:
        camera.move_back(before, worse=torch.ones(len(cameras), dtype=torch.bool), lens=True)
        print(f"outlines: at best the surface is {off:.2f} pixels off its masks, so they do not tell where cameras are")
        return None
    matrix, vector = normal_equations(slopes, error, weights, view, len(cameras), damping=0.0)
    numbers = camera.numbers()
    return PriorInformation(numbers, (_any_width(matrix, vector)[0] / (_ALIKE * variance)).to(numbers))


def _seen(
    camera: RefinedCamera,
    cameras: Cameras,
    reduced: Callable[[Cameras], Cameras],
    finder: RimFinder,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Slopes [R, 1, N + 1] and errors [R, 1] of the outlines in pixels of the silhouettes, their weights and views.

    The last slope is that by a width of which all masks are too wide.
    """
    believed = reduced(camera.estimated(cameras))
    rims = finder.points(believed)
    of_views = rims.points.split(torch.bincount(rims.views, minlength=len(cameras)).tolist())
    place = torch.cat([believed.select([view]).project(points)[0][0] for view, points in enumerate(of_views)])
    place = place * place.new_tensor([cameras.width / believed.width, cameras.height / believed.height])
    pixel = place.floor()
    rays = cameras.rays(rims.views, pixel[:, 1], pixel[:, 0], place - pixel)
    # A pixel's ray that moves outwards meets the surface no more: it is seen farther inside the mask's outline.
    outwards = rims.normals / rims.widths[:, None]
    distances = (rims.points - believed.camera_to_world[rims.views, :, 3]).norm(dim=-1, keepdim=True)
    device = camera.motions.motion.device
    view, by_origin, by_direction = (x.to(device) for x in (rims.views, outwards, distances * outwards))
    slopes = camera.slopes(rays.to(device), view, by_origin[:, None], by_direction[:, None]).double()
    slopes = torch.cat([slopes, torch.ones_like(slopes[..., :1])], -1)
    error, weights = (x.to(slopes) for x in (rims.misfits / rims.widths, rims.weights))
    return slopes, error[:, None], weights, view


def _any_width(
    matrix: Float[Tensor, "N N"], vector: Float[Tensor, "N"]
) -> tuple[Float[Tensor, "N-1 N-1"], Float[Tensor, "N-1"]]:
    """Normal equations with the last number whatever fits best (Schur's complement)."""
    column, last = matrix[:-1, -1], matrix[-1, -1]
    return matrix[:-1, :-1] - torch.outer(column, column) / last, vector[:-1] - column * (vector[-1] / last)
