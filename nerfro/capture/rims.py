"""Where views see the outlines of a surface, and how far these are from the outlines of their masks."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import binary_erosion, distance_transform_edt
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.capture.moving_mesh import MovingMesh, Surface, unit
from nerfro.capture.visual_hull import Silhouettes
from nerfro.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh

# For each view the number of the outline's pixel that is nearest to each of its pixels.
Outlines: TypeAlias = "dict[int, Int[np.ndarray, 'H W']]"

# A binary mask's outline is known to about this, pixels. The misfits' median over it is how far the surface still is
# from the masks: the two limits below widen with it, so that it never loses them all.
_TYPICAL = 0.35
# Outlines farther than this from a mask's belong to folds of the surface in front of itself; where the weight of an
# observation is halved, pixels. That falls to this share of it for masks of shares, which are surer than binary ones.
_GATE, _HALVED, _SUREST = 3.0, 0.7, 0.3


class Rims(NamedTuple):
    """Where the surface's outlines are seen: on edge (first, second) of the mesh, `share` of the way to second.

    To meet the mask's outline the surface has to move by `misfit` along `normal` there, world units.
    """

    first: Int[np.ndarray, "K"]
    second: Int[np.ndarray, "K"]
    share: Float[np.ndarray, "K"]
    normal: Float[np.ndarray, "K 3"]  # unit, outwards, across the line of sight
    misfit: Float[np.ndarray, "K"]
    weight: Float[np.ndarray, "K"]
    width: Float[np.ndarray, "K"]  # of a pixel there, world units
    view: Int[np.ndarray, "K"]  # that sees it

    def points(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "K 3"]:
        """Where they are."""
        share = self.share[:, None]
        return (1 - share) * vertices[self.first] + share * vertices[self.second]


class RimPoints(NamedTuple):
    """Points of a surface that views see on the outlines of their masks; lengths in world units."""

    points: Float[Tensor, "K 3"]
    normals: Float[Tensor, "K 3"]  # unit, outwards, across the line of sight
    misfits: Float[Tensor, "K"]  # how far each has to move outwards to lie on the outline
    weights: Float[Tensor, "K"]  # of these: less where most others are nearer
    widths: Float[Tensor, "K"]  # of a pixel there
    views: Int[Tensor, "K"]


class RimFinder:
    """Where views see the outlines of a surface that are near those of their masks.

    What does not depend on the cameras is prepared once, for those that move.
    """

    def __init__(self, mesh: TriangleMesh, silhouettes: Silhouettes) -> None:
        self._surface = MovingMesh(mesh.faces).surface(mesh.vertices)
        self._silhouettes, self._outlines = silhouettes, outlines_of(silhouettes)

    def points(self, cameras: Cameras | None = None) -> RimPoints:
        """With other cameras than the silhouettes', if they are given."""
        silhouettes = self._silhouettes if cameras is None else replace(self._silhouettes, cameras=cameras)
        rims = find_rims(self._surface, silhouettes, self._outlines)
        return RimPoints(
            points=_tensor(rims.points(self._surface.vertices)),
            normals=_tensor(rims.normal),
            misfits=_tensor(rims.misfit),
            weights=_tensor(rims.weight),
            widths=_tensor(rims.width),
            views=torch.from_numpy(rims.view),
        )


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values).float()


def outlines_of(silhouettes: Silhouettes) -> Outlines:
    """Of all views."""
    return {view: _nearest_outline_pixel(mask) for view, mask in enumerate((silhouettes.masks > 0.5).numpy())}


def find_rims(surface: Surface, silhouettes: Silhouettes, outlines: Outlines) -> Rims:
    """The outermost rims that every view sees near each pixel of its mask's outline.

    A smooth surface turns away from a view between vertices, where normals say so; a sharp one at an edge of which the
    view sees one side.

    Raises:
        NerfroError: no view sees the surface.
    """
    cameras, vertices = silhouettes.cameras, surface.vertices
    ends = vertices[surface.edges]
    spacing = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
    parts = []
    for view, outline in outlines.items():
        eye = cameras.camera_to_world[view, :, 3].double().numpy()
        first, second, share, normal = _turning(surface, eye)
        points = vertices[first] + share[:, None] * (vertices[second] - vertices[first])
        places = torch.from_numpy(points).float()
        inside, width = (values.double().numpy() for values in silhouettes.depth_inside(view, places)[:2])
        known = np.flatnonzero(np.isfinite(inside))
        if not len(known):
            continue
        # Pixels narrower than an edge may be met by no rim but one of a fold, so they are taken together.
        pixels = max(1, int(np.ceil(spacing / width[known].mean())))
        cell = _look_up(outline, cameras.select([view]), places[known], pixels)
        order = np.lexsort((inside[known], cell))
        outermost = known[order[np.diff(cell[order], prepend=-1) != 0]]
        of_view = np.full(len(outermost), view)
        parts.append((*(values[outermost] for values in (first, second, share, normal, inside, width)), of_view))
    if not parts:
        raise NerfroError("no view sees the surface where it looks; surface, poses and masks do not belong together")
    first, second, share, normal, misfit, width, views = (np.concatenate(values) for values in zip(*parts, strict=True))
    spread = float(np.median(np.abs(misfit))) / _TYPICAL
    near = np.abs(misfit) < _GATE * max(1.0, spread)
    weight = 1 / (1 + (misfit / (_HALVED * max(_SUREST, spread))) ** 2)
    return Rims(*(each[near] for each in (first, second, share, normal, misfit * width, weight, width, views)))


def _turning(surface: Surface, eye: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where a surface turns away from an eye: ends of edges, shares of the way between, and normals, see `Rims`."""
    vertices, edges, normals, creases, beside = surface
    facing = (normals * (vertices - eye)).sum(1)[edges]
    smooth = np.flatnonzero((facing[:, 0] > 0) != (facing[:, 1] > 0))
    shares = facing[smooth, 0] / (facing[smooth, 0] - facing[smooth, 1])
    away = (beside * (vertices[creases[:, 0]] - eye)[:, None]).sum(-1) > 0
    sharp = creases[away[:, 0] != away[:, 1]]

    (first, second), share = np.r_[edges[smooth], sharp].T, np.r_[shares, np.full(len(sharp), 0.5)]
    along = vertices[second] - vertices[first]
    look = unit(vertices[first] + share[:, None] * along - eye)
    normal = (1 - share[:, None]) * normals[first] + share[:, None] * normals[second]
    # A sharp edge is seen to move across itself alone, whichever way the sides beside it look.
    across = np.cross(look, along)
    across *= np.sign((across * normal).sum(1, keepdims=True))
    normal -= (normal * look).sum(1, keepdims=True) * look
    normal[len(smooth) :] = across[len(smooth) :]
    return first, second, share, unit(normal)


def _look_up(outline: Int[np.ndarray, "H W"], camera: Cameras, points: Tensor, pixels: int) -> Int[np.ndarray, "P"]:
    """Number of the square of pixels x pixels that holds the part of the outline nearest to each point."""
    place = camera.project(points)[0][0].numpy()
    row = place[:, 1].astype(np.int64).clip(0, camera.height - 1)
    column = place[:, 0].astype(np.int64).clip(0, camera.width - 1)
    nearest = outline[row, column]
    return nearest // camera.width // pixels * camera.width + nearest % camera.width // pixels


def _nearest_outline_pixel(inside: np.ndarray) -> Int[np.ndarray, "H W"]:
    """Number of the pixel of a mask's outline that is nearest to each pixel."""
    outline = inside & ~binary_erosion(inside, border_value=1)
    rows, columns = distance_transform_edt(~outline, return_distances=False, return_indices=True)
    return rows.astype(np.int64) * inside.shape[1] + columns
