"""Masks of all views from the masks of some views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool
from numpy.typing import ArrayLike
from skimage.draw import polygon2mask

from nerfro.cameras import Cameras
from nerfro.errors import NerfroError
from nerfro.silhouettes.outline_hull import AGREES, FEWEST_VIEWS, OutlineHull

# Largest number of given masks at which a body of revolution is tried.
_FEW = 12


def polygon_mask(polygon: ArrayLike, size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Return the pixels whose centres lie inside a polygon.

    Args:
        polygon: vertices (column, row), in pixels from the upper left corner of the image.
        size: width and height of the image.
    """
    return polygon2mask(size[::-1], np.array(polygon, np.float64)[:, ::-1] - 0.5)


Shape = Literal["visual hull", "body of revolution"]


@dataclass(frozen=True)
class Segmentation:
    """Masks of all views.

    Attributes:
        masks: by view, the given masks included.
        by_hull: views whose mask is the projection of the shape.
        shape: shape that the projections show.
        agreement: by view of a given mask, intersection over union of the mask and this shape.
        overlaps: by view, intersection over union of the mask of Segment Anything 2 and the visual hull.
    """

    masks: dict[int, Bool[np.ndarray, "H W"]]
    by_hull: list[int]
    shape: Shape
    agreement: dict[int, float]
    overlaps: dict[int, float] = field(default_factory=dict)


def check_tracked(
    cameras: Cameras, given: Mapping[int, Bool[np.ndarray, "H W"]], tracked: Mapping[int, Bool[np.ndarray, "H W"]]
) -> Segmentation:
    """Compare masks of Segment Anything 2 with the visual hull of all masks, and replace those that disagree.

    Args:
        cameras: cameras of all views.
        given: known masks by view, which do not change.
        tracked: masks of all other views.

    Raises:
        NerfroError: the masks have no common visual hull.
    """
    outlines = OutlineHull(cameras, {**given, **tracked})
    hull = outlines.hull() if len(outlines) >= FEWEST_VIEWS else None
    if hull is None:
        raise NerfroError(
            "Segment Anything 2 does not find the same object in several images; outline the object in more images"
        )
    seen = outlines.seen_from([*given, *tracked], hull)
    overlaps = {view: _overlap(mask, seen[view]) for view, mask in tracked.items()}
    by_hull = [view for view in tracked if overlaps[view] < AGREES]
    masks = {**given, **tracked, **{view: seen[view] for view in by_hull}}
    agreement = {view: _overlap(mask, seen[view]) for view, mask in given.items()}
    return Segmentation(masks, by_hull, "visual hull", agreement, overlaps)


def propagate(cameras: Cameras, given: Mapping[int, Bool[np.ndarray, "H W"]]) -> Segmentation:
    """Make the masks of all views from given masks of some views.

    The masks of all other views are projections of a body of revolution, if one agrees with the given masks, and
    otherwise of their visual hull.

    Args:
        cameras: cameras of all views.
        given: known masks by view.

    Raises:
        NerfroError: the given masks do not determine a shape.
    """
    wanted = [view for view in range(len(cameras)) if view not in given]
    outlines = OutlineHull(cameras, given)
    body = outlines.revolution() if 2 <= len(outlines) <= _FEW else None
    if body is None and len(outlines) < FEWEST_VIEWS:
        raise NerfroError(
            f"{len(outlines)} masks or outlines do not determine the shape; outline the object in two views from "
            f"different directions if it is a body of revolution, otherwise in at least {FEWEST_VIEWS}"
        )
    common = outlines.hull() if body is None else body
    if common is None:
        raise NerfroError(
            "the visual hull of the given masks is empty; correct the masks or the poses, and check the format of the "
            "data set (data=), which determines the camera axes"
        )
    seen = outlines.seen_from(range(len(cameras)), common)
    agreement = {view: _overlap(mask, seen[view]) for view, mask in given.items()}
    shape: Shape = "visual hull" if body is None else "body of revolution"
    return Segmentation(seen | dict(given), wanted, shape, agreement)


def _overlap(one: Bool[np.ndarray, "H W"], other: Bool[np.ndarray, "H W"]) -> float:
    """Compute the intersection over union of two masks; 1 for empty masks."""
    either = (one | other).sum()
    return float((one & other).sum() / either) if either else 1.0
