"""The hull of silhouettes that come one after the other, and which view is next."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float

from nerfro.cameras import Cameras
from nerfro.capture.pose_conventions import GOOD_OVERLAP, coarse_agreement
from nerfro.capture.silhouettes import mesh_silhouettes
from nerfro.capture.targets import opencv
from nerfro.capture.visual_hull import Silhouettes, carve_grid, centre_lines, extract_surface, find_box, remove_strays
from nerfro.geometry.lines import nearest_point
from nerfro.geometry.mesh import TriangleMesh

# The object and its surroundings are looked at in at most so many pixels along the longer side.
MAX_SIDE = 480
# A mask agrees with a hull where they overlap by this much.
AGREES = 0.85
FEWEST_VIEWS = 3
_VOXELS = 80
# Share of the views that may be wrong about any point of space.
_WRONG_SHARE = 0.1
# Views whose directions differ by this many degrees look from elsewhere; within the lesser angle they look from one
# side, where the lines through their masks' centres may meet anywhere, behind the cameras too.
_ELSEWHERE, _ONE_SIDE = 25.0, 15.0
# From one side the depth is only known from where the cameras look; the box is so many times larger.
_UNCERTAIN = 1.6


class OutlineHull:
    """Silhouettes of some of the cameras' views, none empty, and their visual hull."""

    def __init__(self, cameras: Cameras, masks: Mapping[int, Bool[np.ndarray, "H W"]]) -> None:
        scale = max(1.0, max(cameras.width, cameras.height) / MAX_SIDE)
        self.size = cameras.width, cameras.height
        self.cameras = cameras.resized(round(cameras.width / scale), round(cameras.height / scale))
        self._outlines: dict[int, Silhouettes] = {}
        for view, mask in masks.items():
            self.add(view, mask)

    def __len__(self) -> int:
        return len(self._outlines)

    def __contains__(self, view: int) -> bool:
        return view in self._outlines

    def add(self, view: int, mask: Bool[np.ndarray, "H W"]) -> None:
        """Take up a silhouette; a view without the object says nothing."""
        size = self.cameras.width, self.cameras.height
        share = opencv().resize(mask.astype(np.float32), size, interpolation=opencv().INTER_AREA)
        if (share > 0.5).any():
            self._outlines[view] = Silhouettes.of(self.cameras.select([view]), torch.from_numpy(share[None]))

    def add_if_agreed(self, view: int, mask: Bool[np.ndarray, "H W"]) -> bool:
        """Take up a silhouette if the hull with it looks like all masks."""
        self.add(view, mask)
        if view not in self:
            return False
        silhouettes = self._silhouettes()
        agreement = coarse_agreement(silhouettes, int(_WRONG_SHARE * len(silhouettes)))
        if agreement.min() < GOOD_OVERLAP:
            del self._outlines[view]
        return view in self

    def hull(self, without: int | None = None) -> TriangleMesh | None:
        """The hull of all views but one; None where no point lies inside their masks."""
        silhouettes = self._silhouettes(without)
        wrong = int(_WRONG_SHARE * len(silhouettes))
        centre = self._centre_from_one_side(silhouettes)
        box = find_box(silhouettes, wrong) if centre is None else _box_around(centre, silhouettes)
        distances, corner, spacing = carve_grid(silhouettes, box, _VOXELS, wrong)
        remove_strays(distances)
        return extract_surface(distances, corner, spacing) if (distances < 0).any() else None

    def seen_from(self, view: int, hull: TriangleMesh | None) -> Bool[np.ndarray, "H W"]:
        """The silhouette of a hull in the size of the images."""
        if hull is None:
            return np.zeros(self.size[::-1], bool)
        seen = mesh_silhouettes(hull, self.cameras.select([view]), 1)[0].numpy().astype(np.float32)
        return opencv().resize(seen, self.size, interpolation=opencv().INTER_LINEAR) > 0.5

    def next_view(self, refused: list[int]) -> int | None:
        """The nearest view that looks from elsewhere than those that are here or refused; None where there is none."""
        silhouettes = self._silhouettes()
        centre = self._centre_from_one_side(silhouettes)
        centre = nearest_point(*centre_lines(silhouettes)) if centre is None else centre
        towards = self.cameras.camera_to_world[:, :, 3].double().numpy() - centre
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        # Those on opposite sides see one outline, so that angles are those between lines.
        cosines = np.abs(towards @ towards[[*self._outlines, *refused]].T).max(1)
        elsewhere = np.flatnonzero(cosines <= np.cos(np.radians(_ELSEWHERE)))
        return int(elsewhere[cosines[elsewhere].argmax()]) if len(elsewhere) else None

    def _silhouettes(self, without: int | None = None) -> Silhouettes:
        views = [view for view in self._outlines if view != without]
        views = views * 2 if len(views) == 1 else views  # a hull takes two
        parts = [self._outlines[view] for view in views]
        masks, distances, cut = (torch.cat([getattr(p, name) for p in parts]) for name in ("masks", "distances", "cut"))
        return Silhouettes(self.cameras.select(views), masks, distances, cut)

    def _centre_from_one_side(self, silhouettes: Silhouettes) -> Float[np.ndarray, "3"] | None:
        """Where the object is if all views look from one side: as far along the first line as all cameras look."""
        origins, directions = centre_lines(silhouettes)
        if np.abs(directions @ directions.T).min() < np.cos(np.radians(_ONE_SIDE)):
            return None
        poses = self.cameras.camera_to_world.double().numpy()
        offset = nearest_point(poses[:, :, 3], -poses[:, :, 2]) - origins[0]
        return origins[0] + max(float(offset @ directions[0]), 1e-3 * float(np.linalg.norm(offset))) * directions[0]


def _box_around(centre: Float[np.ndarray, "3"], silhouettes: Silhouettes) -> Float[np.ndarray, "2 3"]:
    """A cube as wide as the first mask, and wider, for its depth is uncertain."""
    cameras, inside = silhouettes.cameras, silhouettes.masks[0] > 0.5
    pixels = max(int(inside.any(axis).sum()) for axis in (0, 1))
    distance = float(np.linalg.norm(centre - cameras.camera_to_world[0, :, 3].double().numpy()))
    half_side = _UNCERTAIN * 0.5 * pixels * distance / float(cameras.fx[0])
    return np.stack([centre - half_side, centre + half_side])
