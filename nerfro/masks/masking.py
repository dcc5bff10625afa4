"""Segmentation of the object by GrabCut, guided by the visual hull of consistent silhouettes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike
from scipy.ndimage import binary_fill_holes, label
from skimage.draw import polygon2mask

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.mesh import TriangleMesh
from nerfro.masks.outline_hull import AGREES, MAX_SIDE, MIN_VIEWS, OutlineHull, OutlineHullSettings
from nerfro.poses.opencv import opencv
from nerfro.silhouettes.silhouettes import intersection_over_union


@dataclass(frozen=True)
class SegmentationSettings(AlgorithmSettings):
    """Settings of the segmentation by GrabCut (`propagate`).

    Attributes:
        iterations: number of iterations of GrabCut.
        background_margin: margin around the region that provides the background colours, as a fraction of the longer
            side.
        reach: how far the object may extend beyond its projected hull, as a fraction of the hull's diameter.
        core: depth of the certain core of the projected hull, as the same fraction.
        few: largest number of given masks at which a body of revolution and the methods are compared.
        hull: settings of the visual hull that guides the segmentation.
    """

    iterations: int = 5
    background_margin: float = 0.4
    reach: float = 0.06
    core: float = 0.2
    few: int = 12
    hull: OutlineHullSettings = field(default=OutlineHullSettings(), repr=False)


def grab_cut(
    image: UInt8[np.ndarray, "H W 3"],
    likely: Bool[np.ndarray, "H W"],
    possible: Bool[np.ndarray, "H W"],
    certain: Bool[np.ndarray, "H W"] | None = None,
    settings: SegmentationSettings = SegmentationSettings(),
) -> Bool[np.ndarray, "H W"]:
    """Segment an object in an sRGB image by the colours inside and outside (GrabCut, Rother et al., SIGGRAPH 2004).

    Args:
        image: 8-bit sRGB image.
        likely: pixels that probably show the object.
        possible: pixels that may show the object.
        certain: pixels that certainly show the object.
        settings: number of iterations, and margin.

    Returns:
        Mask of the largest connected component, without holes; empty if no pixel remains.
    """
    cv2 = opencv()
    mask = np.zeros_like(likely)
    rows, columns = (np.flatnonzero(possible.any(axis)) for axis in (1, 0))
    if len(rows) == 0:
        return mask
    margin = int(settings.background_margin * max(np.ptp(rows), np.ptp(columns))) + 4
    window = tuple(slice(max(0, one[0] - margin), one[-1] + 1 + margin) for one in (rows, columns))
    height, width = likely[window].shape
    scale = min(1.0, MAX_SIDE / max(height, width))
    small = max(1, round(width * scale)), max(1, round(height * scale))

    def shrink(region: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "h w"]:
        return cv2.resize(region[window].astype(np.uint8), small, interpolation=cv2.INTER_NEAREST) > 0

    labels = np.full(small[::-1], cv2.GC_BGD, np.uint8)
    labels[shrink(possible)] = cv2.GC_PR_BGD
    labels[shrink(likely & possible)] = cv2.GC_PR_FGD
    if certain is not None:
        labels[shrink(certain & possible)] = cv2.GC_FGD
    num_inside = int((labels & 1).sum())
    if not (labels == cv2.GC_BGD).any() or min(num_inside, labels.size - num_inside) < 5:
        return likely & possible  # too few samples for the five mixture components of one of the two regions
    cv2.setRNGSeed(0)
    pixels = cv2.resize(np.ascontiguousarray(image[window]), small, interpolation=cv2.INTER_AREA)
    # GrabCut does not depend on the order of the channels.
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(pixels, labels, None, *models, settings.iterations, cv2.GC_INIT_WITH_MASK)
    segmented = np.where(labels & 1, 1.0, 0.0).astype(np.float32)
    enlarged = cv2.resize(cv2.GaussianBlur(segmented, (0, 0), 0.7), (width, height), interpolation=cv2.INTER_LINEAR)
    mask[window] = enlarged > 0.5
    return _largest_component(mask & possible)


def box_region(box: ArrayLike, size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Return the pixels of a box (left, top, right, bottom) in an image of a width and a height, in pixels."""
    region = np.zeros(size[::-1], bool)
    left, top, right, bottom = np.rint(np.array(box, np.float64)).astype(int)
    region[max(0, top) : max(0, bottom), max(0, left) : max(0, right)] = True
    return region


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
        overlaps: by view, intersection over union of the segmented mask and the visual hull.
        by_hull: views whose mask is the projection of the shape, because there is no segmented mask, or because it
            disagrees with the visual hull.
        shape: shape that the projections show.
        agreement: by view of a given mask, intersection over union of the mask and this shape.
        segmenter: method that made all masks that are neither given nor projections, for messages.
    """

    masks: dict[int, Bool[np.ndarray, "H W"]]
    overlaps: dict[int, float]
    by_hull: list[int]
    shape: Shape
    agreement: dict[int, float]
    segmenter: str = "GrabCut"


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
    hull = outlines.hull() if len(outlines) >= MIN_VIEWS else None
    if hull is None:
        raise NerfroError(
            "Segment Anything 2 does not find the same object in several images; outline the object in more images"
        )
    seen = outlines.seen_from([*given, *tracked], hull)
    overlaps = {view: float(intersection_over_union(mask, seen[view])) for view, mask in tracked.items()}
    by_hull = [view for view in tracked if overlaps[view] < AGREES]
    masks = {**given, **tracked, **{view: seen[view] for view in by_hull}}
    agreement = {view: float(intersection_over_union(mask, seen[view])) for view, mask in given.items()}
    return Segmentation(masks, overlaps, by_hull, "visual hull", agreement, "Segment Anything 2")


def propagate(
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    cameras: Cameras,
    given: Mapping[int, Bool[np.ndarray, "H W"]],
    hull_only: bool = False,
    progress: Callable[[], None] = lambda: None,
    settings: SegmentationSettings = SegmentationSettings(),
) -> Segmentation:
    """Segment the object in all views, starting from given masks of one or more views.

    If a body of revolution agrees with at least two given masks, its projections are the masks of all other views.

    Otherwise the reference views are the given ones. If fewer than three masks are given, further reference views are
    added one by one: GrabCut segments the nearest view from a new direction, guided by the hull of the reference views,
    and the view is accepted if the extended hull still agrees with all reference masks. Then every other view is
    segmented by GrabCut, guided by the hull of the reference views. If GrabCut and the hull disagree, the mask of the
    view is the projection of the hull of all accepted masks. GrabCut is not used if the hull of the other given masks
    predicts the given masks better than GrabCut does, as for clear glass, which has the colours of its background.

    Args:
        images: 8-bit sRGB images of all views.
        cameras: cameras of all views.
        given: known masks by view.
        hull_only: do not use GrabCut; all missing masks are projections of the hull.
        progress: called once for each view without a given mask.
        settings: settings of GrabCut and of the hull.

    Raises:
        NerfroError: too few views agree with the given masks.
    """
    wanted = [view for view in range(len(images)) if view not in given]
    settings.use()
    outlines = OutlineHull(cameras, given, settings.hull)
    guide, shape, uses_grab_cut = _choose_strategy(images, outlines, given, wanted, hull_only, settings)
    accepted, overlaps = {}, {}
    if uses_grab_cut:
        for view in wanted:
            region, cut = _guided(images[view], outlines, view, guide, settings)
            overlaps[view] = float(intersection_over_union(cut, region))
            if overlaps[view] >= AGREES:
                accepted[view] = cut
            progress()
    surface = OutlineHull(cameras, {**given, **accepted}, settings.hull).hull() if accepted else guide
    by_hull = [view for view in wanted if view not in accepted]
    projections = outlines.seen_from([*by_hull, *given], surface)
    masks = {**given, **accepted, **{view: projections[view] for view in by_hull}}
    agreement = {view: float(intersection_over_union(mask, projections[view])) for view, mask in given.items()}
    return Segmentation(masks, overlaps, by_hull, shape, agreement)


def _choose_strategy(
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    outlines: OutlineHull,
    given: Mapping[int, Bool[np.ndarray, "H W"]],
    wanted: Sequence[int],
    hull_only: bool,
    settings: SegmentationSettings,
) -> tuple[TriangleMesh | None, Shape, bool]:
    """Choose between projections and GrabCut, and between a body of revolution and the visual hull (see `propagate`).

    Args:
        images: 8-bit sRGB images of all views.
        outlines: visual hull of the given masks, to which reference views may be added.
        given: known masks by view.
        wanted: views without a given mask.
        hull_only: do not use GrabCut.
        settings: settings of GrabCut.

    Returns:
        The surface whose projections guide GrabCut, or are the masks (None only if no mask is missing), its shape, and
        whether GrabCut segments the views.

    Raises:
        NerfroError: too few views agree with the given masks.
    """
    body = outlines.revolution() if wanted and 2 <= len(given) <= settings.few else None
    if body is not None:
        return body, "body of revolution", False
    if not hull_only and len(given) < MIN_VIEWS:
        _add_reference_views(images, outlines, settings)
    if wanted and len(outlines) < MIN_VIEWS:
        if hull_only:
            raise NerfroError(
                f"{len(outlines)} masks or outlines do not determine the shape; outline the object in two views from "
                f"different directions if it is a body of revolution, otherwise in at least {MIN_VIEWS}"
            )
        raise NerfroError(
            f"{len(outlines)} of {len(images)} views agree on a shape, {MIN_VIEWS} are needed, because the outlined "
            "object is not found in other images by its colours; outline the whole object in more views from all "
            "sides, or provide masks"
        )
    hull = outlines.hull()
    if wanted and hull is None:
        raise NerfroError(
            "the visual hull of the given masks is empty; correct the masks or the poses, and check the format of the "
            "data set (data=), which determines the camera axes"
        )
    are_few = MIN_VIEWS < len(given) <= settings.few
    uses_grab_cut = not hull_only and not (are_few and _hull_predicts_better(images, outlines, given, settings))
    return hull, "visual hull", uses_grab_cut


def _guided(
    image: UInt8[np.ndarray, "H W 3"],
    outlines: OutlineHull,
    view: int,
    hull: TriangleMesh | None,
    settings: SegmentationSettings,
) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Return the projection of the hull of all other views, and the mask of GrabCut that starts from the projection."""
    region = outlines.seen_from([view], outlines.hull(without=view) if view in outlines else hull)[view]
    core = _distance(region) > settings.core * _diameter(region)
    return region, grab_cut(image, region, _dilate(region, settings.reach), core, settings)


def _hull_predicts_better(
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    outlines: OutlineHull,
    given: Mapping[int, Bool[np.ndarray, "H W"]],
    settings: SegmentationSettings,
) -> bool:
    """Test whether the hull of the other given masks predicts each given mask better than GrabCut in the mean."""
    gains = []
    for view, mask in given.items():
        region, cut = _guided(images[view], outlines, view, None, settings)
        gains.append(intersection_over_union(region, mask) - intersection_over_union(cut, mask))
    return float(np.mean(gains)) > 0


def _add_reference_views(
    images: Sequence[UInt8[np.ndarray, "H W 3"]], outlines: OutlineHull, settings: SegmentationSettings
) -> None:
    """Add views from new directions as long as all masks agree with their visual hull."""
    refused: list[int] = []
    while (view := outlines.next_view(refused)) is not None:
        region = outlines.seen_from([view], outlines.hull())[view]
        mask = grab_cut(images[view], region, _dilate(region, settings.reach), settings=settings)
        if not outlines.add_if_agreed(view, mask):
            refused.append(view)


def _diameter(region: Bool[np.ndarray, "H W"]) -> float:
    """Return the diameter of a disk of the same area, in pixels."""
    return 2 * float(np.sqrt(region.sum() / np.pi))


def _dilate(region: Bool[np.ndarray, "H W"], fraction: float) -> Bool[np.ndarray, "H W"]:
    """Dilate a region by a fraction of its diameter, and by at least two pixels."""
    return _distance(~region) <= max(2.0, fraction * _diameter(region))


def _distance(region: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Compute the distance of each pixel of a region to the nearest pixel outside, in pixels."""
    return opencv().distanceTransform(region.astype(np.uint8), opencv().DIST_L2, 5)


def _largest_component(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    components, num_components = label(mask)
    if num_components == 0:
        return mask
    return binary_fill_holes(components == 1 + np.bincount(components.ravel())[1:].argmax())
