"""Silhouettes by GrabCut, led from view to view by the visual hull of those that are done."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike
from scipy.ndimage import binary_closing, binary_fill_holes, label

from nerfro.cameras import Cameras
from nerfro.capture.targets import opencv
from nerfro.capture.visual_hull import Silhouettes, find_box, nearest_point
from nerfro.errors import NerfroError

_ITERATIONS = 5
# GrabCut sees the object and its surroundings in at most so many pixels along the longer side.
_MAX_SIDE = 480
# The surroundings that it learns the background from, as a share of the region's longer side.
_SURROUNDINGS = 0.4
# How far the object may reach beyond the projected hull, and what is surely object within it, shares of its diameter.
_REACH, _CORE = 0.06, 0.2
_GRID = 56
# The box is found anew until so many views are done.
_SETTLED = 8
# Share of the views that may be wrong about any point of space.
_WRONG_SHARE = 0.1
# GrabCut that keeps less than this of the projected hull has failed.
_LEAST_KEPT = 0.3
# From one view the depth is only known from where the cameras look; the box is so many times larger.
_UNCERTAIN = 1.6


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
    scale = min(1.0, _MAX_SIDE / max(height, width))
    small = max(1, round(width * scale)), max(1, round(height * scale))

    def shrink(region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        return cv2.resize(region[window].astype(np.uint8), small, interpolation=cv2.INTER_NEAREST) > 0

    labels = np.full(small[::-1], cv2.GC_BGD, np.uint8)
    labels[shrink(possible)] = cv2.GC_PR_BGD
    labels[shrink(likely & possible)] = cv2.GC_PR_FGD
    if certain is not None:
        labels[shrink(certain & possible)] = cv2.GC_FGD
    if not (labels == cv2.GC_BGD).any() or not (labels & 1).any():
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


def propagate(
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    cameras: Cameras,
    done: Mapping[int, Bool[np.ndarray, "H W"]],
    progress: Callable[[int], None] = lambda count: None,
) -> tuple[dict[int, Bool[np.ndarray, "H W"]], dict[int, float]]:
    """Find the object in all views from its silhouettes in some, at least one.

    The next view is always one that looks from nearly where a done one does. After all have had their turn, those that
    were not given are cut out once more, each from the hull of all others. `progress` counts the cuts, two a view.

    Returns:
        Silhouettes of all views, and for each that was not given its overlap (intersection over union) with the hull of
        the others.

    Raises:
        NerfroError: no other view shows what the given silhouettes show.
    """
    masks = dict(done)
    hull = _Hull(cameras, masks)
    wanted = [view for view in range(len(images)) if view not in masks]
    count = 0
    while len(masks) < len(images):
        view = _nearest_view(cameras, hull.centre, [v for v in wanted if v not in masks], list(masks))
        region = hull.seen_from(view)
        found = grab(images[view], region, _grown(region, _REACH))
        masks[view] = found if found.sum() >= _LEAST_KEPT * region.sum() else region
        if len(masks) <= _SETTLED:
            hull = _Hull(cameras, masks)
        else:
            hull.add(view, masks[view])
        progress(count := count + 1)
    if wanted and not any(masks[view].any() for view in wanted):
        raise NerfroError("what is outlined is seen in no other image; draw the outline around the whole object")
    hull = _Hull(cameras, masks)
    refined, overlaps = {}, {}
    for view in wanted:
        region = hull.seen_from(view)
        if not region.any():  # the others contradict each other here; what was found stays
            region = masks[view]
        core = _distance(region) > _CORE * _diameter(region)
        found = grab(images[view], region, _grown(region, _REACH), core)
        refined[view] = found if found.sum() >= _LEAST_KEPT * region.sum() else region
        overlaps[view] = float((found & region).sum() / max(1, (found | region).sum()))
        progress(count := count + 1)
    return masks | refined, overlaps


class _Hull:
    """Points of a grid, and which views say that each is not object."""

    def __init__(self, cameras: Cameras, masks: Mapping[int, Bool[np.ndarray, "H W"]]) -> None:
        self.cameras = cameras
        masks = {view: mask for view, mask in masks.items() if mask.any()}  # a view without the object says nothing
        box = _find_box(cameras, masks)
        self.centre = box.mean(0)
        axes = [torch.linspace(float(box[0][a]), float(box[1][a]), _GRID) for a in range(3)]
        self.points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        self.voxel = float(axes[0][1] - axes[0][0])
        self.outside: dict[int, Bool[np.ndarray, "P"]] = {}
        self.count = np.zeros(len(self.points), np.int32)
        for view, mask in masks.items():
            self.add(view, mask)

    def add(self, view: int, mask: Bool[np.ndarray, "H W"]) -> None:
        if not mask.any():
            return
        silhouettes = Silhouettes.of(self.cameras.select([view]), torch.from_numpy(mask[None]).float())
        inside, width, _ = silhouettes.depth_inside(0, self.points)
        # A little generous, for thin parts lie between the grid's points.
        self.outside[view] = (inside * width < -0.3 * self.voxel).numpy()
        self.count += self.outside[view]

    def seen_from(self, view: int) -> Bool[np.ndarray, "H W"]:
        """The silhouette of what the other views leave over."""
        own = self.outside.get(view)
        num_others = len(self.outside) - (own is not None)
        inside = (self.count if own is None else self.count - own) <= int(_WRONG_SHARE * num_others)
        camera = self.cameras.select([view])
        region = np.zeros((camera.height, camera.width), bool)
        points = self.points[torch.from_numpy(inside)]
        pixels, depth = (values[0] for values in camera.project(points))
        pixels, depth = pixels[depth > 0], depth[depth > 0]
        if len(depth) == 0:
            return region
        # The grid's points are drawn into pixels of a voxel's width, which then have no gaps.
        step = int(np.clip(np.ceil(self.voxel * float(camera.fx) / float(depth.min())), 1, max(region.shape)))
        coarse = np.zeros((-(-camera.height // step), -(-camera.width // step)), bool)
        column, row = (pixels / step).floor().long().T
        framed = (column >= 0) & (column < coarse.shape[1]) & (row >= 0) & (row < coarse.shape[0])
        coarse[row[framed].numpy(), column[framed].numpy()] = True
        coarse = binary_fill_holes(binary_closing(np.pad(coarse, 2)))[2:-2, 2:-2]
        return np.kron(coarse, np.ones((step, step), bool))[: camera.height, : camera.width]


def _find_box(cameras: Cameras, masks: Mapping[int, Bool[np.ndarray, "H W"]]) -> Float[np.ndarray, "2 3"]:
    views = sorted(masks)
    chosen = cameras.select(views)
    inside = torch.from_numpy(np.stack([masks[view] for view in views]))
    if len(views) > 1:
        return find_box(Silhouettes.of(chosen, inside.float()))
    rows, columns = torch.nonzero(inside[0], as_tuple=True)
    middle = torch.tensor([float(rows.float().mean())]), torch.tensor([float(columns.float().mean())])
    ray = chosen.rays(torch.zeros(1, dtype=torch.long), *middle)
    origin, direction = ray.origins[0].double().numpy(), ray.directions[0].double().numpy()
    # Cameras look at the object, more or less.
    poses = cameras.camera_to_world.double().numpy()
    target = nearest_point(poses[:, :, 3], -poses[:, :, 2])
    distance = max(float((target - origin) @ direction), 1e-3 * float(np.linalg.norm(target - origin)))
    pixels = max(float(np.ptp(rows)), float(np.ptp(columns))) + 1
    half_side = _UNCERTAIN * 0.5 * pixels * distance / float(chosen.fx)
    return np.stack([origin + distance * direction - half_side, origin + distance * direction + half_side])


def _nearest_view(cameras: Cameras, centre: Float[np.ndarray, "3"], wanted: list[int], done: list[int]) -> int:
    towards = cameras.camera_to_world[:, :, 3].double().numpy() - centre
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return wanted[int((towards[wanted] @ towards[done].T).max(1).argmax())]


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
