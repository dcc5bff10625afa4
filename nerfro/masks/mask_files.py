"""Input and output of `nerfro.mask`: outlines, existing masks, and new masks beside the images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.core.paths import user_path
from nerfro.data.base import DataSource, Frame
from nerfro.data.image_files import read_mask, read_size, to_unit
from nerfro.data.masks import METHOD, POLYGON, TRACKED, checksum, method_of, without_masks
from nerfro.files.images import save_image, sheet, to_8bit
from nerfro.files.reading import read_json
from nerfro.masks.masking import Segmentation, box_region, check_tracked, grab_cut, polygon_mask, propagate
from nerfro.masks.outline_hull import AGREES, MIN_VIEWS
from nerfro.masks.tracking import load_tracker, track_object
from nerfro.poses.collection import PHOTOGRAPH_SUFFIXES
from nerfro.poses.opencv import opencv
from nerfro.poses.structure_from_motion import numeric_order

_SHEET = "masks.png"
_TILE, _COLUMNS = 220, 6  # width of a tile in pixels, tiles per row
_OUTSIDE = (0.0, 0.0, 90.0)  # 8-bit colour that is added outside the mask


def read_outlines(source: object) -> dict[str, list]:
    """Read outlines by image name, each a box or a polygon, from a mapping or a JSON file."""
    if OmegaConf.is_config(source):
        source = OmegaConf.to_container(source)  # type: ignore[arg-type]
    if isinstance(source, str):
        source = read_json(user_path(source), "give a JSON file of outlines by name")
    if source is None:
        return {}
    if not isinstance(source, Mapping):
        raise NerfroError("outlines= must be {NAME:[LEFT,TOP,RIGHT,BOTTOM]} or a JSON file with such a mapping")
    outlines = {}
    for name, outline in source.items():
        try:
            numbers = np.array(outline, np.float64)
        except (TypeError, ValueError):
            numbers = np.empty(0)
        box = numbers.shape == (4,) and numbers[0] < numbers[2] and numbers[1] < numbers[3]
        polygon = numbers.ndim == 2 and numbers.shape[0] >= 3 and numbers.shape[1] == 2
        if not (box or polygon) or not np.isfinite(numbers).all():
            raise NerfroError(
                f"the outline of {name} is {outline}; give a box [left,top,right,bottom] or a polygon of at least "
                "three vertices [column,row]"
            )
        if polygon and _crosses_itself(numbers):
            raise NerfroError(f"the outline of {name} crosses itself; give its vertices in the order along the outline")
        outlines[str(name)] = numbers.tolist()
    return outlines


def _crosses_itself(polygon: Float[np.ndarray, "vertices 2"]) -> bool:
    """Test whether two sides of a polygon cross between their ends."""
    starts, ends = polygon, np.roll(polygon, -1, axis=0)
    sides = (ends - starts)[:, None]

    def turns(points: Float[np.ndarray, "vertices 2"]) -> Float[np.ndarray, "vertices vertices"]:
        """Return on which side of each side, by rows, each point lies."""
        offsets = points[None] - starts[:, None]
        return np.sign(sides[..., 0] * offsets[..., 1] - sides[..., 1] * offsets[..., 0])

    separates = turns(starts) * turns(ends) < 0
    return bool((separates & separates.T).any())


def load_all(source: DataSource) -> tuple[Cameras, list[UInt8[np.ndarray, "H W 3"]], list[Frame]]:
    """Load the views of all splits without masks, each image once.

    Raises:
        NerfroError: the images differ in size, or the format does not provide image files.
    """
    parts: list[Cameras] = []
    images: list[UInt8[np.ndarray, "H W 3"]] = []
    frames: list[Frame] = []
    for split in source.splits:
        with without_masks():
            views = source.load(split)
        if len(views.frames) != len(views):
            raise NerfroError("this data format does not provide image files; convert the data set to data=opencv")
        loaded = {frame.image for frame in frames}
        fresh = [i for i, frame in enumerate(views.frames) if frame.image not in loaded]
        parts += [views.cameras.select(fresh)] if fresh else []  # a split without new images may have another size
        images += [to_8bit(views.images[i]).numpy() for i in fresh]
        frames += [views.frames[i] for i in fresh]
    sizes = {(part.width, part.height) for part in parts}
    if len(sizes) > 1:
        raise NerfroError(f"the splits have images of several sizes ({sorted(sizes)}); set data.eval_crop=1")
    return Cameras.joined(parts), images, frames


def find_frame(name: str, frames: list[Frame]) -> int:
    """Find a frame by its name in the data set, or by its file name with, without or before a change of extension."""
    stem = Path(name).stem if Path(name).suffix.lower() in PHOTOGRAPH_SUFFIXES else name
    matches = [i for i, frame in enumerate(frames) if frame.name == name]
    matches = matches or [i for i, frame in enumerate(frames) if frame.image.name == name]
    matches = matches or [i for i, frame in enumerate(frames) if frame.image.stem in (name, stem)]
    if len(matches) != 1:
        problem = "is not an image of the data set" if not matches else f"matches {len(matches)} images of the data set"
        raise NerfroError(f"outlines: {name} {problem}; names of the data set look like {frames[0].name}")
    return matches[0]


def check_start(frames: list[Frame], outlined: Collection[int], kept: Collection[int], hull_only: bool) -> None:
    """Refuse data without any mask or outline, without a missing mask, or with one file for several masks."""
    if not outlined and not kept:
        raise NerfroError(
            "there is no mask to start from; give the outline of the object in one image, for example "
            f"outlines={{{frames[0].name}:[LEFT,TOP,RIGHT,BOTTOM]}}"
        )
    if hull_only and len(outlined) + len(kept) < MIN_VIEWS:
        raise NerfroError(
            f"hull_only=true needs masks or outlines of at least {MIN_VIEWS} images from all sides, and there are "
            f"{len(outlined) + len(kept)}; outline the object in more images"
        )
    if len(kept) == len(frames):
        raise NerfroError("all images have masks; delete the wrong ones, or set overwrite=true")
    repeated = [path for path, count in Counter(mask_file(frame) for frame in frames).items() if count > 1]
    if repeated:
        raise NerfroError(f"{repeated[0]} would be the mask of two images that differ only in extension; rename one")


def mask_file(frame: Frame) -> Path:
    """Return the file for the mask of a frame: the existing one, unless it is a JPEG."""
    if frame.mask is not None and frame.mask.suffix == ".png":
        return frame.mask
    return frame.image.with_name(f"mask_{frame.image.stem}.png")


def read_resized(
    mask: Path, image: Path, size: tuple[int, int], labels: Sequence[int] | None
) -> Bool[np.ndarray, "H W"]:
    """Read the mask of an image file and resize it to the width and height of the loaded images."""
    coverage = to_unit(read_mask(mask, labels))
    height, width = coverage.shape
    # The sides of downscaled images are rounded, so their aspect ratio may differ slightly.
    stored = read_size(image)
    if height * stored[0] != width * stored[1]:
        raise NerfroError(
            f"mask {mask} has {width}x{height} pixels, which is not the aspect ratio of its image; replace the mask"
        )
    return opencv().resize(coverage, size, interpolation=opencv().INTER_AREA) > 0.5


def save_mask(frame: Frame, mask: Bool[np.ndarray, "H W"], method: str | None = None) -> None:
    """Write the mask of a frame as a black and white image in the size of its image file.

    Args:
        frame: the frame.
        mask: pixels of the object.
        method: what the mask follows from, for `nerfro.data.masks.method_of`; None for a mask of its own.
    """
    picture, size = Image.fromarray(np.uint8(255 * mask)), read_size(frame.image)[:2]
    if picture.size != size:
        picture = picture.resize(size, Image.Resampling.BICUBIC).point(lambda level: 255 * (level > 127))
    text = PngInfo()
    if method is not None:
        text.add_text(METHOD, f"{method}:{checksum(picture)}")
    save_image(mask_file(frame), picture, pnginfo=text)


def mask_sheet(
    images: list[UInt8[np.ndarray, "H W 3"]],
    frames: list[Frame],
    found: Segmentation,
) -> Image.Image:
    """Draw a contact sheet of all views, darkened outside the masks, with doubtful masks first and given masks last."""
    labels = {view: f"{overlap:.3f}" for view, overlap in found.overlaps.items()}
    labels |= {view: f"{labels.get(view, '')} hull".strip() for view in found.by_hull}
    order = sorted(range(len(images)), key=lambda view: (view not in labels, found.overlaps.get(view, 0.0)))
    stride = max(1, images[0].shape[1] // (2 * _TILE))
    pictures, captions = [], []
    for view in order:
        inside, image = (torch.from_numpy(array[::stride, ::stride]) for array in (found.masks[view], images[view]))
        pictures.append(torch.where(inside[..., None], image / 255, image / 1020 + torch.tensor(_OUTSIDE) / 255))
        captions.append(f"{labels.get(view, 'given')}  {frames[view].image.stem}")
    legend = f"overlap of {found.segmenter} and visual hull; " if found.overlaps else ""
    legend += f"hull: the mask is the projection of the {found.shape}; dark: outside the mask"
    return sheet(pictures, captions, _TILE, _COLUMNS, legend)


def report_masks(frames: list[Frame], found: Segmentation) -> None:
    """Print how well the masks agree with the shape of the object, the least certain masks first."""
    print(f"{len(found.by_hull)} masks are projections of the {found.shape}")
    empty = [frames[view].name for view, mask in found.masks.items() if not mask.any()]
    if empty:
        print(f"views that do not show the object: {first_of(empty)}")
    if found.agreement:
        worst = min(found.agreement, key=found.agreement.__getitem__)
        print(
            f"the {found.shape} overlaps by {found.agreement[worst]:.3f} or more with the {len(found.agreement)} given "
            f"masks (least: {frames[worst].name})"
        )
    if found.overlaps:
        print(f"overlap (intersection over union) of the mask of {found.segmenter} with the visual hull:")
    for view in sorted(found.overlaps, key=lambda view: found.overlaps[view]):
        taken = " (mask from the hull)" if view in found.by_hull else ""
        print(f"  {found.overlaps[view]:.4f}  {frames[view].name}{taken}")
    doubtful = [frames[view].name for view in found.by_hull if view in found.overlaps]
    if doubtful:
        warn(
            f"{len(doubtful)} of {len(frames)} views: {found.segmenter} and the visual hull overlap by less than "
            f"{AGREES} ({first_of(doubtful)}); their masks are projections of the hull and slightly "
            "too large: check them first"
        )


@dataclass(frozen=True)
class MaskTask:
    """Views of a data set that need masks.

    Attributes:
        source: the data set.
        cameras: cameras of all views.
        images: 8-bit sRGB images of all views.
        frames: frames of all views.
        kept: existing masks by view, which do not change.
        hull_only: do not use GrabCut.
        tracker: network that follows the object through the photographs, instead of GrabCut.
    """

    source: DataSource
    cameras: Cameras
    images: list[UInt8[np.ndarray, "H W 3"]]
    frames: list[Frame]
    kept: dict[int, Bool[np.ndarray, "H W"]]
    hull_only: bool
    tracker: Any = None

    @classmethod
    def load(cls, source: DataSource, config: DictConfig, outlines: Mapping[str, list]) -> MaskTask:
        """Load all views and check the options; masks that follow from others are not kept.

        Raises:
            NerfroError: there is nothing to start from, or nothing to do.
        """
        opencv()  # report a missing package before the long work starts
        if config.sam2 is not None and (config.hull_only or config.view):
            raise NerfroError("sam2= segments all photographs, so it excludes hull_only=true and view=true; remove one")
        tracker = None if config.sam2 is None else load_tracker(user_path(config.sam2))
        cameras, images, frames = load_all(source)
        outlined, kept = {find_frame(name, frames) for name in outlines}, {}
        size = cameras.width, cameras.height
        for view, frame in enumerate(frames):
            if frame.mask is not None and not config.overwrite:
                method = method_of(frame.mask)
                stays = {POLYGON: view not in outlined, TRACKED: tracker is None}
                if method is None or stays.get(method, False):
                    kept[view] = read_resized(frame.mask, frame.image, size, source.mask_labels)
        if not config.view:
            check_start(frames, outlined, kept, config.hull_only)
        return cls(source, cameras, images, frames, kept, config.hull_only or config.view, tracker)

    def segment(self, outlines: Mapping[str, list], progress: Callable[[], None] = lambda: None) -> Segmentation:
        """Make the masks of all views from the kept masks and outlines by image name.

        Raises:
            NerfroError: a mask is empty, or too few views agree with the given masks.
        """
        size, given = (self.cameras.width, self.cameras.height), dict(self.kept)
        boxes: dict[int, list[float]] = {}
        for name, outline in outlines.items():
            view = find_frame(name, self.frames)
            if view in self.kept:
                raise NerfroError(
                    f"{name} already has a mask, {self.frames[view].mask}; delete the mask, or set overwrite=true to "
                    "replace all masks"
                )
            scale = np.divide(size, read_size(self.frames[view].image)[:2])
            scaled = (np.reshape(outline, (-1, 2)) * scale).reshape(np.shape(outline))
            if scaled.ndim == 2:  # the user's polygon is the mask
                given[view] = polygon_mask(scaled, size)
            elif self.tracker is not None:
                boxes[view] = scaled.tolist()
            else:
                region = box_region(scaled, size)
                given[view] = grab_cut(self.images[view], region, region)
        for view, mask in given.items():
            if not mask.any():
                raise NerfroError(f"{self.frames[view].name}: the outline or mask is empty; draw it around the object")
        if self.tracker is None:
            return propagate(self.images, self.cameras, given, self.hull_only, progress)
        names = [frame.image.name for frame in self.frames]
        order = numeric_order(names) or sorted(range(len(names)), key=names.__getitem__)
        rank = {view: number for number, view in enumerate(order)}
        images = [self.images[view] for view in order]
        prompts = {rank[view]: mask for view, mask in given.items()}
        corners = {rank[view]: box for view, box in boxes.items()}
        tracked = track_object(self.tracker, images, prompts, corners, progress)
        return check_tracked(self.cameras, given, {order[number]: mask for number, mask in tracked.items()})

    def save(self, outlines: Mapping[str, list], segmentation: Segmentation) -> str:
        """Write all masks but the kept ones and a contact sheet, print a report, and return a message."""
        polygons = {find_frame(name, self.frames) for name, outline in outlines.items() if np.ndim(outline) == 2}
        made = [view for view in range(len(self.frames)) if view not in self.kept]
        for view in made:
            # Hull and segmentation agree on an empty mask if a photograph does not show the object.
            by_hull = view in segmentation.by_hull or not segmentation.masks[view].any()
            method = POLYGON if view in polygons else segmentation.shape if by_hull else None
            method = TRACKED if method is None and self.tracker is not None else method
            save_mask(self.frames[view], segmentation.masks[view], method)
        path = self.source.root / _SHEET
        save_image(path, mask_sheet(self.images, self.frames, segmentation))
        report_masks(self.frames, segmentation)
        return f"wrote {len(made)} masks beside their images (mask_*.png); check them in {path}"
