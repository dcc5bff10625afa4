"""Check that the mesh of the object and the photographs belong together, before training."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError, warn
from nerfro.data.base import Views
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.lines import nearest_point
from nerfro.geometry.mesh import TriangleMesh, num_decimals
from nerfro.geometry.orientation import area_vectors
from nerfro.media.base import Medium
from nerfro.silhouettes.silhouettes import PixelBlocks

_NUM_VIEWS, _MAX_PIXELS = 8, 32
# Intersection over union of silhouettes and masks: below the first number the mesh is refused, below the second one a
# warning is printed, and below the third one as well if a change of the mesh reaches the fourth one.
_NONE, _POOR, _DOUBTFUL, _EXPLAINED = 0.05, 0.5, 0.75, 0.85
# Factors between metres, centimetres, millimetres and inches.
_UNITS = (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0, 0.0254, 25.4, 2.54, 1 / 0.0254, 1 / 25.4, 1 / 2.54)


class _Change(NamedTuple):
    """A linear map and a shift of the mesh, with a description."""

    matrix: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    description: str


_SAME = _Change(np.eye(3), np.zeros(3), "")


@torch.no_grad()
def require_match(medium: Medium, views: Views) -> None:
    """Compare the silhouettes of the mesh with some masks, and say whether unit, axes or place of the mesh are wrong.

    Args:
        medium: medium of the run; only media that store their meshes are compared.
        views: training views.

    Raises:
        NerfroError: all cameras lie inside the object, or hardly any pixel of a mask shows the mesh.
    """
    indices, _ = medium(views.cameras.camera_to_world[:, :, 3].to(medium.box))
    inside = bool((indices != 1).all())
    comparison, outline = None, medium.outline
    if outline is not None and views.masks is not None:
        comparison = _Comparison.of(outline, views, medium.origin)
    agreement = 1.0 if comparison is None else comparison.agreement(_SAME)
    if not inside and agreement >= _DOUBTFUL:
        return
    reason = "" if comparison is None else comparison.explanation()
    if not inside and agreement >= _POOR and not reason:
        return
    reason = reason or "check that unit, axes and place of medium.mesh are those of the cameras"
    if inside:
        sides = (medium.content_box[1] - medium.content_box[0]).tolist()
        size = " x ".join(f"{side:.3g}" for side in sides)
        raise NerfroError(f"all cameras lie inside the object, which is {size} world units large; {reason}")
    problem = f"the silhouettes of medium.mesh agree with the masks only to {agreement:.0%}; {reason}"
    if agreement < _NONE:
        raise NerfroError(problem)
    warn(problem)


class _Comparison(NamedTuple):
    """Rays through the pixels of reduced masks.

    Attributes:
        mesh: surface of the object.
        world_origin: origin of the world in the coordinates of mesh and cameras.
        intersector: intersections with the mesh.
        cameras: reduced cameras of V views.
        origins, directions: one ray per pixel, view by view.
        masks: pixels of the object.
    """

    mesh: TriangleMesh
    world_origin: Float[np.ndarray, "3"]
    intersector: MeshIntersector
    cameras: Cameras
    origins: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]
    masks: Bool[Tensor, "V Q"]

    @classmethod
    def of(cls, mesh: TriangleMesh, views: Views, origin: Float[np.ndarray, "3"]) -> _Comparison | None:
        """Reduce the masks of some views; None if all are empty or full, or without Embree."""
        compared = views.select(views.spread(_NUM_VIEWS))
        blocks = PixelBlocks(compared.cameras, _MAX_PIXELS)
        assert compared.masks is not None
        masks = torch.stack([blocks.mean(mask).flatten() for mask in compared.masks]) > 0.5
        useful = (masks.any(1) & ~masks.all(1)).nonzero()[:, 0].tolist()
        if not useful:
            return None
        try:
            intersector = MeshIntersector(mesh.triangles)
        except NerfroError:
            return None
        cameras = blocks.cameras(compared.cameras).select(useful)
        rays = [cameras.image_rays(view) for view in range(len(cameras))]
        origins, directions = (torch.cat([getattr(ray, name) for ray in rays]) for name in ("origins", "directions"))
        return cls(mesh, -origin, intersector, cameras, origins, directions, masks[useful])

    def silhouettes(self, change: _Change) -> Bool[Tensor, "V Q"]:
        """Return the pixels of the changed mesh."""
        inverse = torch.from_numpy(np.linalg.inv(change.matrix))
        origins = (self.origins.double() - torch.from_numpy(change.shift)) @ inverse.T
        directions = torch.nn.functional.normalize(self.directions.double() @ inverse.T, dim=-1)
        return (self.intersector.first_hits(origins, directions) >= 0).view(self.masks.shape)

    def agreement(self, change: _Change) -> float:
        """Return the mean intersection over union of the masks and the silhouettes of the changed mesh."""
        ours = self.silhouettes(change)
        return float(((ours & self.masks).sum(1) / (ours | self.masks).sum(1)).mean())

    def explanation(self) -> str:
        """Return the simplest change of the mesh that agrees with the masks, as advice; empty if there is none."""
        turns = [self._about_origin(matrix, description) for matrix, description in _turns()]
        units = [self._about_origin(unit * np.eye(3), f"scaled by {unit:.4g}") for unit in _UNITS]
        both = [
            self._about_origin(unit.matrix @ turn.matrix, f"{unit.description} and {turn.description}")
            for unit, turn in itertools.product(units, turns)
        ]
        for changes in (units, turns, both, list(self._moves(turns))):
            scores = [self.agreement(change) for change in changes]
            best = int(np.argmax(scores))
            if scores[best] >= _EXPLAINED:
                return f"the mesh {changes[best].description} agrees to {scores[best]:.0%}, so change it or the poses"
        return ""

    def _about_origin(self, matrix: Float[np.ndarray, "3 3"], description: str) -> _Change:
        """Return a linear map about the origin of the world."""
        return _Change(matrix, self.world_origin - matrix @ self.world_origin, description)

    def _moves(self, turns: list[_Change]) -> Iterator[_Change]:
        """Move the centre of the mesh to the point that all masks show, with the scale of the masks, in any axes."""
        centres, target = self.cameras.camera_to_world[:, :, 3].double().numpy(), self._middle(self.masks)
        # The mean projected area of a convex body is a quarter of its surface (Cauchy).
        area = 0.5 * np.linalg.norm(area_vectors(self.mesh.triangles), axis=-1).sum() / 4
        depths = np.linalg.norm(target - centres, axis=1)
        areas = self.masks.sum(1).numpy() * (depths / self.cameras.fx.double().numpy()) ** 2
        scale = float(np.sqrt(areas.mean() / area))
        scale = 1.0 if abs(scale - 1) < 0.1 else scale
        decimals = num_decimals(scale * float(np.ptp(self.mesh.bounds, axis=0).max()), 4)
        for turn in (_SAME, *turns):
            matrix = scale * turn.matrix
            shift = target - matrix @ self.mesh.bounds.mean(0)
            ours = self.silhouettes(_Change(matrix, shift, ""))
            shift += target - self._middle(ours) if ours.any(1).all() else 0
            words = [f"scaled by {scale:.3g}"] * (scale != 1) + [turn.description] * bool(turn.description)
            yield _Change(matrix, shift, " and ".join([*words, f"moved by {shift.round(decimals).tolist()}"]))

    def _middle(self, pixels: Bool[Tensor, "V Q"]) -> Float[np.ndarray, "3"]:
        """Return the point nearest to the rays through the centres of some pixels in each view."""
        axes = (pixels[..., None] * self.directions.view(*pixels.shape, 3)).sum(1)
        axes = torch.nn.functional.normalize(axes, dim=-1).double()
        return nearest_point(self.cameras.camera_to_world[:, :, 3].double().numpy(), axes.numpy())


def _turns() -> list[tuple[Float[np.ndarray, "3 3"], str]]:
    """Return all permutations of the axes with all signs, rotations before reflections, without the identity."""
    turns = []
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
        names = ", ".join(("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
        turns.append((matrix, f"with (x, y, z) replaced by ({names})"))
    return sorted(turns[1:], key=lambda turn: np.linalg.det(turn[0]) < 0)
