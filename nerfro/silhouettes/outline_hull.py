"""Visual hull of the silhouettes of some views, and the body of revolution that agrees with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool

from nerfro.cameras import Cameras
from nerfro.geometry.lines import nearest_point
from nerfro.geometry.mesh import TriangleMesh
from nerfro.opencv import opencv
from nerfro.silhouettes.pose_conventions import overlap
from nerfro.silhouettes.revolution import fit_revolution
from nerfro.silhouettes.silhouettes import mesh_silhouettes
from nerfro.silhouettes.upright import camera_up
from nerfro.silhouettes.visual_hull import Silhouettes, carve_mesh, centre_lines, find_box

# Images are downscaled to at most so many pixels along the longer side.
MAX_SIDE = 480
# Smallest intersection over union of a mask and a hull that agree.
AGREES = 0.85
FEWEST_VIEWS = 3
_VOXELS = 80
# Fraction of the views that may be wrong about any point.
_WRONG_FRACTION = 0.1
# Smallest intersection over union of a body of revolution and each of its masks, which may be drawn by hand.
_SYMMETRIC = 0.94


class OutlineHull:
    """Visual hull of the masks of some views; empty masks are ignored.

    Args:
        cameras: cameras of all views.
        masks: masks by view.
    """

    def __init__(self, cameras: Cameras, masks: Mapping[int, Bool[np.ndarray, "H W"]]) -> None:
        scale = max(1.0, max(cameras.width, cameras.height) / MAX_SIDE)
        self.size = cameras.width, cameras.height
        self.cameras = cameras.resized(round(cameras.width / scale), round(cameras.height / scale))
        self._outlines: dict[int, Silhouettes] = {}
        for view, mask in masks.items():
            self._add(view, mask)

    def __len__(self) -> int:
        return len(self._outlines)

    def _add(self, view: int, mask: Bool[np.ndarray, "H W"]) -> None:
        """Add the silhouette of a view, unless the mask is empty."""
        size = self.cameras.width, self.cameras.height
        coverage = opencv().resize(mask.astype(np.float32), size, interpolation=opencv().INTER_AREA)
        if (coverage > 0.5).any():
            self._outlines[view] = Silhouettes.of(self.cameras.select([view]), torch.from_numpy(coverage[None]))

    def revolution(self) -> TriangleMesh | None:
        """Fit a body of revolution to the masks; None if these do not agree with one."""
        hull = self.hull()
        up = camera_up(self.cameras)
        if hull is None or up is None:
            return None
        # The hull of few views says less about the axis than the cameras and the centres of the masks do.
        silhouettes = self._silhouettes()
        body = fit_revolution(hull, silhouettes, axis=(nearest_point(*centre_lines(silhouettes)), up))
        if body is None:
            return None
        return body if min(overlap(body, one, MAX_SIDE)[0] for one in self._outlines.values()) >= _SYMMETRIC else None

    def hull(self) -> TriangleMesh | None:
        """Compute the visual hull; None if it is empty."""
        silhouettes = self._silhouettes()
        wrong = int(_WRONG_FRACTION * len(silhouettes))
        return carve_mesh(silhouettes, find_box(silhouettes, wrong), _VOXELS, wrong)

    def seen_from(self, views: Sequence[int], mesh: TriangleMesh) -> dict[int, Bool[np.ndarray, "H W"]]:
        """Render the silhouettes of a mesh in the size of the images, by view."""
        seen = mesh_silhouettes(mesh, self.cameras.select(list(views)), 1).numpy().astype(np.float32)
        enlarged = (opencv().resize(one, self.size, interpolation=opencv().INTER_LINEAR) > 0.5 for one in seen)
        return dict(zip(views, enlarged, strict=True))

    def _silhouettes(self) -> Silhouettes:
        parts = list(self._outlines.values())
        masks, distances, cut = (torch.cat([getattr(p, name) for p in parts]) for name in ("masks", "distances", "cut"))
        return Silhouettes(self.cameras.select([*self._outlines]), masks, distances, cut)
