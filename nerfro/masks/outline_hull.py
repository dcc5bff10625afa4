"""Visual hull of a growing set of silhouettes, and choice of the next view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from nerfro.core.cameras import Cameras
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.lines import nearest_point
from nerfro.geometry.mesh import TriangleMesh
from nerfro.poses.opencv import opencv
from nerfro.silhouettes.agreement import GOOD_OVERLAP, coarse_agreement, overlap
from nerfro.silhouettes.revolution import fit_revolution
from nerfro.silhouettes.silhouettes import mesh_silhouettes
from nerfro.silhouettes.upright import camera_up
from nerfro.silhouettes.visual_hull import Silhouettes, carve_mesh, centre_lines, find_box

# Images are downscaled to at most so many pixels along the longer side.
MAX_SIDE = 480
# Smallest intersection over union of a mask and a hull that agree.
AGREES = 0.85
MIN_VIEWS = 3


@dataclass(frozen=True)
class OutlineHullSettings(AlgorithmSettings):
    """Settings of the visual hull of a growing set of silhouettes (`OutlineHull`).

    Attributes:
        voxels: number of voxels along the longest side of the hull.
        wrong_fraction: fraction of the views that may be wrong about any point.
        min_view_angle: smallest angle in degrees between the directions of different views.
        one_side: angle in degrees within which all views look from one side, so that the rays through the centroids of
            the masks do not determine the depth of the object.
        depth_margin: enlargement of the box if all views look from one side.
        min_symmetric: smallest intersection over union of a body of revolution and each of its masks, which may be
            drawn by hand.
        max_loss: largest decrease of the overlap of the hull with any initial mask, by all added views together.
    """

    voxels: int = 80
    wrong_fraction: float = 0.1
    min_view_angle: float = 25.0
    one_side: float = 15.0
    depth_margin: float = 1.6
    min_symmetric: float = 0.94
    max_loss: float = 0.03


class OutlineHull:
    """Visual hull of the masks of some views; empty masks are ignored.

    Args:
        cameras: cameras of all views.
        masks: initial masks by view.
        settings: limits.
    """

    def __init__(
        self,
        cameras: Cameras,
        masks: Mapping[int, Bool[np.ndarray, "H W"]],
        settings: OutlineHullSettings = OutlineHullSettings(),
    ) -> None:
        settings.use()
        self.settings = settings
        scale = max(1.0, max(cameras.width, cameras.height) / MAX_SIDE)
        self.size = cameras.width, cameras.height
        self.cameras = cameras.resized(round(cameras.width / scale), round(cameras.height / scale))
        self._outlines: dict[int, Silhouettes] = {}
        self._hulls: dict[int | None, TriangleMesh | None] = {}  # by the view left out; cleared if the views change
        for view, mask in masks.items():
            self.add(view, mask)
        self._initial = list(self._outlines)
        self._initial_overlaps: Float[np.ndarray, "V"] | None = None  # computed before the first view is added

    def __len__(self) -> int:
        return len(self._outlines)

    def __contains__(self, view: int) -> bool:
        return view in self._outlines

    def add(self, view: int, mask: Bool[np.ndarray, "H W"]) -> None:
        """Add the silhouette of a view, unless the mask is empty."""
        size = self.cameras.width, self.cameras.height
        coverage = opencv().resize(mask.astype(np.float32), size, interpolation=opencv().INTER_AREA)
        if (coverage > 0.5).any():
            self._hulls.clear()
            self._outlines[view] = Silhouettes.of(self.cameras.select([view]), torch.from_numpy(coverage[None]))

    def add_if_agreed(self, view: int, mask: Bool[np.ndarray, "H W"]) -> bool:
        """Add the silhouette of a view if the extended hull agrees with all masks; returns whether it was added.

        A mask that lacks a part of the object removes this part from the hull, and thereby from all other masks. The
        hull must therefore keep its overlap with the initial masks.
        """
        if self._initial_overlaps is None:
            self._initial_overlaps = self._overlaps(self.hull())
        self.add(view, mask)
        if view not in self:
            return False
        silhouettes = self._silhouettes()
        agreement = coarse_agreement(silhouettes, int(self.settings.wrong_fraction * len(silhouettes)))
        agrees = agreement.min() >= GOOD_OVERLAP
        if not agrees or (self._overlaps(self.hull()) < self._initial_overlaps - self.settings.max_loss).any():
            del self._outlines[view]
            self._hulls.clear()
        return view in self

    def revolution(self) -> TriangleMesh | None:
        """Fit a body of revolution to the initial masks; None if these do not agree with one."""
        hull = self.hull()
        up = camera_up(self.cameras)
        if hull is None or up is None:
            return None
        # The hull of few views says less about the axis than the cameras and the centres of the masks do.
        silhouettes = self._silhouettes()
        body = fit_revolution(hull, silhouettes, axis=(nearest_point(*centre_lines(silhouettes)), up))
        fits = body is not None and self._overlaps(body).min() >= self.settings.min_symmetric
        return body if fits else None

    def _overlaps(self, hull: TriangleMesh | None) -> Float[np.ndarray, "V"]:
        """Compute the intersection over union of the silhouette of a hull with each initial mask."""
        if hull is None:
            return np.zeros(len(self._initial))
        parts = [self._outlines[view] for view in self._initial]
        return np.array([overlap(hull, part, MAX_SIDE)[0] for part in parts])

    def hull(self, without: int | None = None) -> TriangleMesh | None:
        """Compute the hull of all views, optionally without one; None if the hull is empty."""
        if without not in self._hulls:
            silhouettes = self._silhouettes(without)
            settings, wrong = self.settings, int(self.settings.wrong_fraction * len(silhouettes))
            centre = self._centre_from_one_side(silhouettes)
            if centre is None:
                box = find_box(silhouettes, wrong)
            else:
                box = _box_around(centre, silhouettes, settings.depth_margin)
            self._hulls[without] = carve_mesh(silhouettes, box, settings.voxels, wrong)
        return self._hulls[without]

    def seen_from(self, views: Sequence[int], hull: TriangleMesh | None) -> dict[int, Bool[np.ndarray, "H W"]]:
        """Render the silhouettes of a hull in the size of the images, by view."""
        if hull is None:
            return {view: np.zeros(self.size[::-1], bool) for view in views}
        seen = mesh_silhouettes(hull, self.cameras.select(list(views)), 1).numpy().astype(np.float32)
        enlarged = (opencv().resize(one, self.size, interpolation=opencv().INTER_LINEAR) > 0.5 for one in seen)
        return dict(zip(views, enlarged, strict=True))

    def next_view(self, refused: list[int]) -> int | None:
        """Choose the nearest view whose direction differs from all added and refused views; None if there is none."""
        silhouettes = self._silhouettes()
        centre = self._centre_from_one_side(silhouettes)
        centre = nearest_point(*centre_lines(silhouettes)) if centre is None else centre
        towards = self.cameras.camera_to_world[:, :, 3].double().numpy() - centre
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        # Opposite views see the same outline, so the sign of a direction does not matter.
        cosines = np.abs(towards @ towards[[*self._outlines, *refused]].T).max(1)
        candidates = np.flatnonzero(cosines <= np.cos(np.radians(self.settings.min_view_angle)))
        return int(candidates[cosines[candidates].argmax()]) if len(candidates) else None

    def _silhouettes(self, without: int | None = None) -> Silhouettes:
        views = [view for view in self._outlines if view != without]
        views = views * 2 if len(views) == 1 else views  # a visual hull needs at least two views
        parts = [self._outlines[view] for view in views]
        masks, distances, cut = (torch.cat([getattr(p, name) for p in parts]) for name in ("masks", "distances", "cut"))
        return Silhouettes(self.cameras.select(views), masks, distances, cut)

    def _centre_from_one_side(self, silhouettes: Silhouettes) -> Float[np.ndarray, "3"] | None:
        """Estimate the centre of the object if all views look from one side, else return None.

        The centre lies on the ray through the centroid of the first mask, at the depth of the point that all cameras
        look at.
        """
        origins, directions = centre_lines(silhouettes)
        if np.abs(directions @ directions.T).min() < np.cos(np.radians(self.settings.one_side)):
            return None
        poses = self.cameras.camera_to_world.double().numpy()
        offset = nearest_point(poses[:, :, 3], -poses[:, :, 2]) - origins[0]
        return origins[0] + max(float(offset @ directions[0]), 1e-3 * float(np.linalg.norm(offset))) * directions[0]


def _box_around(centre: Float[np.ndarray, "3"], silhouettes: Silhouettes, margin: float) -> Float[np.ndarray, "2 3"]:
    """Return a cube somewhat wider than the first mask, because the depth is uncertain."""
    cameras, inside = silhouettes.cameras, silhouettes.masks[0] > 0.5
    pixels = max(int(inside.any(axis).sum()) for axis in (0, 1))
    distance = float(np.linalg.norm(centre - cameras.camera_to_world[0, :, 3].double().numpy()))
    half_side = margin * 0.5 * pixels * distance / float(cameras.fx[0])
    return np.stack([centre - half_side, centre + half_side])
