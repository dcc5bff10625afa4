"""Outlines that are given, masks that exist, and those that are written beside their images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from omegaconf import MISSING, OmegaConf
from PIL import Image

from nerfro.cameras import Cameras
from nerfro.capture.masking import Found
from nerfro.capture.outline_hull import FEWEST_VIEWS
from nerfro.capture.targets import opencv
from nerfro.data.base import DataSource, Frame
from nerfro.data.image_files import read_mask, to_unit
from nerfro.data.masks import masks_left_out
from nerfro.data.transforms import read_json
from nerfro.errors import NerfroError
from nerfro.files.drawing import sheet
from nerfro.files.images import save_picture
from nerfro.paths import user_path

_TILE, _COLUMNS, _NAME_LENGTH = 220, 6, 20  # pixels, pictures, characters
_OUTSIDE = (0.0, 0.0, 90.0)  # levels that are added to what is outside


@dataclass
class MaskConfig:
    """What `python -m nerfro.mask` is asked.

    Attributes:
        data: the views (options of the group `data`); those of all splits get masks.
        outlines: by the image's name, a box [left, top, right, bottom] around the object or a rough polygon
            [[column, row], ...], pixels; or a JSON file that holds these.
        hull_only: take the masks that exist, three at least, and project their hull into all other views; nothing is
            cut out by colours.
        overwrite: make masks that exist anew, from the outlines alone; else they are kept and show the way.
    """

    data: Any = MISSING
    outlines: Any = None
    hull_only: bool = False
    overwrite: bool = False


def read_outlines(given: object) -> dict[str, list]:
    """Outlines by name, each a box or a polygon, from a mapping or a file."""
    if OmegaConf.is_config(given):
        given = OmegaConf.to_container(given)  # type: ignore[arg-type]
    if isinstance(given, str):
        given = read_json(user_path(given), "give a JSON file of outlines by name")
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise NerfroError("outlines= must be {NAME:[LEFT,TOP,RIGHT,BOTTOM]}, or a JSON file with such a mapping")
    outlines = {}
    for name, outline in given.items():
        try:
            numbers = np.array(outline, np.float64)
        except (TypeError, ValueError):
            numbers = np.empty(0)
        box = numbers.shape == (4,) and numbers[0] < numbers[2] and numbers[1] < numbers[3]
        polygon = numbers.ndim == 2 and numbers.shape[0] >= 3 and numbers.shape[1] == 2
        if not (box or polygon) or not np.isfinite(numbers).all():
            raise NerfroError(
                f"the outline of {name} is {outline}; give a box [left,top,right,bottom] or a polygon of three or more "
                "[column,row]"
            )
        outlines[str(name)] = numbers.tolist()
    return outlines


def load_all(source: DataSource) -> tuple[Cameras, list[UInt8[np.ndarray, "H W 3"]], list[Frame]]:
    """All splits' views, each image once, without masks; all must be of one size."""
    parts: list[Cameras] = []
    images: list[UInt8[np.ndarray, "H W 3"]] = []
    frames: list[Frame] = []
    for split in source.splits:
        with masks_left_out():
            views = source.load(split)
        if len(views.frames) != len(views):
            raise NerfroError("this data format does not tell where its images lie; convert it to data=opencv")
        known = {frame.image for frame in frames}
        fresh = [i for i, frame in enumerate(views.frames) if frame.image not in known]
        parts += [views.cameras.select(fresh)] if fresh else []  # a split without new images may be cropped
        images += [np.uint8(np.rint(255 * views.images[i].numpy())) for i in fresh]
        frames += [views.frames[i] for i in fresh]
    sizes = {(part.width, part.height) for part in parts}
    if len(sizes) > 1:
        raise NerfroError(f"splits have images of several sizes ({sorted(sizes)}); leave data.eval_crop at 1")
    names = ("camera_to_world", "fx", "fy", "cx", "cy")
    tensors: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    lenses = [torch.zeros(len(part), 9) if part.distortion is None else part.distortion for part in parts]
    return replace(parts[0], **tensors, distortion=torch.cat(lenses)), images, frames


def find_frame(name: str, frames: list[Frame]) -> int:
    """The frame of a name: as the data set calls it, or its file's name with or without extension."""
    found = [i for i, frame in enumerate(frames) if frame.name == name]
    found = found or [i for i, frame in enumerate(frames) if name in (frame.image.name, frame.image.stem)]
    if len(found) != 1:
        what = "is no image of the data" if not found else f"are {len(found)} images of the data"
        raise NerfroError(f"outlines: {name} {what}; its names are like {frames[0].name}")
    return found[0]


def check_start(
    frames: list[Frame], outlined: Mapping[int, object], kept: Mapping[int, object], hull_only: bool
) -> None:
    """Refuse where there is nothing to start from, nothing to do, or no place for a mask."""
    if not outlined and not kept:
        raise NerfroError(
            "there is no mask to start from; give the outline of the object in an image, as in "
            f"outlines={{{frames[0].name}:[LEFT,TOP,RIGHT,BOTTOM]}}"
        )
    if hull_only and len(outlined) + len(kept) < FEWEST_VIEWS:
        raise NerfroError(
            f"hull_only=true takes masks or outlines of {FEWEST_VIEWS} images or more, from all sides; there are "
            f"{len(outlined) + len(kept)}"
        )
    for view in outlined:
        if view in kept:
            raise NerfroError(
                f"{frames[view].name} has a mask, {kept[view]}; delete it, or set overwrite=true to make all masks anew"
            )
    if len(kept) == len(frames):
        raise NerfroError("all images have masks; delete those that are wrong, or set overwrite=true")
    repeated = [path for path, count in Counter(mask_file(frame) for frame in frames).items() if count > 1]
    if repeated:
        raise NerfroError(f"{repeated[0]} would be the mask of two images that differ in extension only; rename one")


def mask_file(frame: Frame) -> Path:
    """Where a frame's mask goes: to where it is, unless that is a JPEG."""
    if frame.mask is not None and frame.mask.suffix == ".png":
        return frame.mask
    return frame.image.with_name(f"mask_{frame.image.stem}.png")


def stored_size(frame: Frame) -> tuple[int, int]:
    """Width and height of a frame's file."""
    with Image.open(frame.image) as image:
        return image.size


def read_resized(mask: Path, size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """A mask in the size (width, height) of the images as they are loaded."""
    share = to_unit(read_mask(mask))
    height, width = share.shape
    if height * size[0] != width * size[1]:
        raise NerfroError(f"mask {mask} has {width}x{height} pixels, of other proportions than its image")
    return opencv().resize(share, size, interpolation=opencv().INTER_AREA) > 0.5


def save_mask(frame: Frame, mask: Bool[np.ndarray, "H W"]) -> None:
    """Write a frame's mask in its image's size, black and white."""
    picture, size = Image.fromarray(np.uint8(255 * mask)), stored_size(frame)
    if picture.size != size:
        picture = picture.resize(size, Image.Resampling.BICUBIC).point(lambda level: 255 * (level > 127))
    save_picture(mask_file(frame), picture)


def mask_sheet(
    images: list[UInt8[np.ndarray, "H W 3"]],
    frames: list[Frame],
    found: Found,
) -> Image.Image:
    """All views with their masks, darkened outside; the doubtful first, those that were given last."""
    told = {view: f"{overlap:.3f}" for view, overlap in found.overlaps.items()}
    told |= {view: f"{told.get(view, '')} hull".strip() for view in found.by_hull}
    order = sorted(range(len(images)), key=lambda view: (view not in told, found.overlaps.get(view, 0.0)))
    stride = max(1, images[0].shape[1] // (2 * _TILE))
    pictures, captions = [], []
    for view in order:
        inside, image = (torch.from_numpy(array[::stride, ::stride]) for array in (found.masks[view], images[view]))
        pictures.append(torch.where(inside[..., None], image / 255, image / 1020 + torch.tensor(_OUTSIDE) / 255))
        captions.append(f"{told.get(view, 'given')}  {frames[view].name[-_NAME_LENGTH:]}")
    legend = "overlap of GrabCut with the hull, and whose mask is the hull's; outside the mask is dark"
    return sheet(pictures, captions, _TILE, _COLUMNS, legend)
