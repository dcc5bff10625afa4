"""Silhouettes by GrabCut and by the visual hull of those that agree."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike
from scipy.ndimage import binary_fill_holes, label

from nerfro.cameras import Cameras
from nerfro.capture.outline_hull import AGREES, FEWEST_VIEWS, MAX_SIDE, OutlineHull
from nerfro.capture.targets import opencv
from nerfro.errors import NerfroError

_ITERATIONS = 5
# The surroundings that GrabCut learns the background from, as a share of the region's longer side.
_SURROUNDINGS = 0.4
# How far the object may reach beyond the projected hull, and what is surely object within it, shares of its diameter.
_REACH, _CORE = 0.06, 0.2
# Colours that OpenCV's GrabCut models each of the two regions with.
_NUM_COLOURS = 5


def grab(
    image: UInt8[np.ndarray, "H W 3"],
    likely: Bool[np.ndarray, "H W"],
    possible: Bool[np.ndarray, "H W"],
    certain: Bool[np.ndarray, "H W"] | None = None,
) -> Bool[np.ndarray, "H W"]:
    """Cut an object out of an sRGB image by the colours inside and outside (Rother et al., GrabCut, SIGGRAPH 2004).

    Returns:
        The largest connected part of the object, without holes; empty where nothing is left.
    """
    cv2 = opencv()
    mask = np.zeros_like(likely)
    rows, columns = (np.flatnonzero(possible.any(axis)) for axis in (1, 0))
    if len(rows) == 0:
        return mask
    margin = int(_SURROUNDINGS * max(np.ptp(rows), np.ptp(columns))) + 4
    window = tuple(slice(max(0, one[0] - margin), one[-1] + 1 + margin) for one in (rows, columns))
    height, width = likely[window].shape
    scale = min(1.0, MAX_SIDE / max(height, width))
    small = max(1, round(width * scale)), max(1, round(height * scale))

    def shrink(region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        return cv2.resize(region[window].astype(np.uint8), small, interpolation=cv2.INTER_NEAREST) > 0

    labels = np.full(small[::-1], cv2.GC_BGD, np.uint8)
    labels[shrink(possible)] = cv2.GC_PR_BGD
    labels[shrink(likely & possible)] = cv2.GC_PR_FGD
    if certain is not None:
        labels[shrink(certain & possible)] = cv2.GC_FGD
    num_inside = int((labels & 1).sum())
    if not (labels == cv2.GC_BGD).any() or min(num_inside, labels.size - num_inside) < _NUM_COLOURS:
        return likely & possible  # nothing to learn one of the two from
    cv2.setRNGSeed(0)
    pixels = cv2.resize(np.ascontiguousarray(image[window]), small, interpolation=cv2.INTER_AREA)
    # OpenCV's own order of channels does not matter to GrabCut.
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(pixels, labels, None, *models, _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    found = np.where(labels & 1, 1.0, 0.0).astype(np.float32)
    enlarged = cv2.resize(cv2.GaussianBlur(found, (0, 0), 0.7), (width, height), interpolation=cv2.INTER_LINEAR)
    mask[window] = enlarged > 0.5
    return _largest_part(mask & possible)


def outline_region(
    outline: ArrayLike, size: tuple[int, int]
) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Where the object is likely, and where it is possible, in an image of a size (width, height).

    The outline is a box (left, top, right, bottom) around the object, or the corners (column, row) of a polygon that
    follows it roughly, pixels.
    """
    region = np.zeros(size[::-1], np.uint8)
    numbers = np.array(outline, np.float64)
    if numbers.ndim == 1:
        left, top, right, bottom = np.rint(numbers).astype(int)
        region[max(0, top) : max(0, bottom), max(0, left) : max(0, right)] = 1
        return region > 0, region > 0
    opencv().fillPoly(region, [np.rint(numbers).astype(np.int32)], 1)
    return region > 0, _grown(region > 0, _REACH)


@dataclass(frozen=True)
class Found:
    """Silhouettes by view, and for each that was not given:

    Attributes:
        overlaps: of GrabCut's mask with the hull of the others (intersection over union).
        by_hull: views whose mask is the hull's, since the two do not agree, or since the hull alone is wanted.
    """

    masks: dict[int, Bool[np.ndarray, "H W"]]
    overlaps: dict[int, float]
    by_hull: list[int]


def propagate(
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    cameras: Cameras,
    given: Mapping[int, Bool[np.ndarray, "H W"]],
    hull_only: bool = False,
    progress: Callable[[], None] = lambda: None,
) -> Found:
    """Find the object in all views from its silhouettes in some, at least one.

    Those that are given lead. Where they are fewer than three, GrabCut adds the nearest views that look from elsewhere:
    each is cut out from the hull of those before, and leads if the hull with it still looks like all their masks. Then
    every view is cut out from the hull of the leading others. Where the two do not agree, the mask is the hull's: of
    all masks that agree.

    Args:
        hull_only: have no mask cut out; the views that lead are those given.
        progress: called once for each view that was not given.

    Raises:
        NerfroError: too few views show what the given silhouettes show.
    """
    wanted = [view for view in range(len(images)) if view not in given]
    outlines = OutlineHull(cameras, given)
    if len(given) < FEWEST_VIEWS:
        _lead(images, outlines)
    if wanted and len(outlines) < FEWEST_VIEWS:
        raise NerfroError(
            f"{len(outlines)} of {len(images)} views agree on a shape, {FEWEST_VIEWS} are needed: what is "
            "outlined is not found in other images by its colours; outline the whole object in more views, or bring "
            "masks, from all sides"
        )
    common = outlines.hull()
    if wanted and common is None:
        raise NerfroError("no point lies inside the masks that are given: correct them, or the poses")
    found, overlaps = {}, {}
    for view in wanted if not hull_only else []:
        region = outlines.seen_from(view, outlines.hull(without=view) if view in outlines else common)
        core = _distance(region) > _CORE * _diameter(region)
        cut = grab(images[view], region, _grown(region, _REACH), core)
        either = (cut | region).sum()
        overlaps[view] = float((cut & region).sum() / either) if either else 1.0
        if overlaps[view] >= AGREES:
            found[view] = cut
        progress()
    by_hull = [view for view in wanted if view not in found]
    hull = OutlineHull(cameras, {**given, **found}).hull() if found else common
    for view in by_hull:
        found[view] = outlines.seen_from(view, hull)
    return Found({**given, **found}, overlaps, by_hull)


def _lead(images: Sequence[UInt8[np.ndarray, "H W 3"]], outlines: OutlineHull) -> None:
    """Add views that look from elsewhere, as long as all agree."""
    refused: list[int] = []
    while (view := outlines.next_view(refused)) is not None:
        region = outlines.seen_from(view, outlines.hull())
        if not outlines.add_if_agreed(view, grab(images[view], region, _grown(region, _REACH))):
            refused.append(view)


def _diameter(region: Bool[np.ndarray, "H W"]) -> float:
    return 2 * float(np.sqrt(region.sum() / np.pi))


def _grown(region: Bool[np.ndarray, "H W"], share: float) -> Bool[np.ndarray, "H W"]:
    return _distance(~region) <= max(2.0, share * _diameter(region))


def _distance(region: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """To the nearest pixel outside, pixels."""
    return opencv().distanceTransform(region.astype(np.uint8), opencv().DIST_L2, 5)


def _largest_part(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    parts, num_parts = label(mask)
    if num_parts == 0:
        return mask
    return binary_fill_holes(parts == 1 + np.bincount(parts.ravel())[1:].argmax())
