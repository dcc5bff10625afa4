"""`python -m nerfro.mask data=... data.root=DIR outlines={NAME:[LEFT,TOP,RIGHT,BOTTOM]}`: masks where none exist."""

from __future__ import annotations

import io
import json
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from jaxtyping import Bool, UInt8
from omegaconf import MISSING, DictConfig, OmegaConf
from PIL import Image, ImageDraw, ImageFont
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from nerfro.cameras import Cameras
from nerfro.capture.masking import grab, outline_region, propagate
from nerfro.capture.targets import opencv
from nerfro.cli import entry_point
from nerfro.data.base import DataSource
from nerfro.data.frames import Frame
from nerfro.data.image_files import read_mask
from nerfro.data.masks import masks_left_out
from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.paths import EMBEDDED_PREFIX, user_path
from nerfro.registry import build

_SHEET = "masks.png"
_TILE, _COLUMNS, _GAP, _LINE = 220, 6, 6, 18  # pixels
# The hull is coarse and a little too large; a mask that overlaps this much less with it than is usual is pointed out.
_DOUBTFUL = 0.9


@dataclass
class MaskConfig:
    """What `python -m nerfro.mask` is asked.

    Attributes:
        data: the views (options of the group `data`); those of all splits get masks.
        outlines: by the image's name, a box [left, top, right, bottom] around the object or a rough polygon
            [[column, row], ...], pixels; or a JSON file that holds these.
        overwrite: make masks that exist anew, from the outlines alone; else they are kept and show the way.
    """

    data: Any = MISSING
    outlines: Any = None
    overwrite: bool = False


@entry_point("mask", MaskConfig)
@torch.no_grad()
def main(config: DictConfig) -> None:
    """Cut the object out where an outline is given, then in all other views, and write what was missing."""
    if str(config.data.root).startswith(EMBEDDED_PREFIX):
        raise NerfroError(f"data.root={config.data.root} ships with nerfro and has its masks; give a folder of yours")
    outlines = read_outlines(config.outlines)
    source = build(config.data)
    cameras, images, frames = load_all(source)
    outlined = {_find_frame(name, frames): outline for name, outline in outlines.items()}
    kept = {} if config.overwrite else {i: frame.mask for i, frame in enumerate(frames) if frame.mask is not None}
    _check(frames, outlined, kept)
    opencv()  # told now, if it is missing, and not after the hull
    size = cameras.width, cameras.height
    done = {view: _read(mask, size) for view, mask in kept.items()}
    for view, outline in outlined.items():
        scaled = np.array(outline, np.float64) * size[0] / _stored_size(frames[view])[0]
        done[view] = grab(images[view], *outline_region(scaled, size))
    for view, mask in done.items():
        if not mask.any():
            raise NerfroError(f"{frames[view].name}: nothing is in the outline or the mask; draw it around the object")
    missing = len(frames) - len(done)
    print(f"{len(kept)} masks exist, {len(outlined)} outlines are given; {missing} views are cut out by the hull")
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()) as progress:
        task = progress.add_task("cutting out", total=2 * missing)
        masks, overlaps = propagate(images, cameras, done, lambda count: progress.update(task, completed=count))
    made = [view for view in range(len(frames)) if view not in kept]
    for view in made:
        write_atomically(_mask_file(frames[view]), _png(masks[view], _stored_size(frames[view])))
    sheet = source.root / _SHEET
    write_atomically(sheet, _draw_sheet(images, frames, masks, overlaps))
    _report(frames, overlaps, made, sheet)
    given = [text for text in HydraConfig.get().overrides.task if text.startswith(("data=", "data."))]
    command = ["python", "-m", "nerfro.preprocess", *given, "medium.ior=1.33"]
    if "data=opencv" not in given and not any(text.startswith("data=") for text in given):
        command.insert(3, "data=opencv")
    print(f"next: {shlex.join(command)}")


def read_outlines(given: object) -> dict[str, list]:
    """Outlines by name, from a mapping or a file.

    Raises:
        NerfroError: the file cannot be read, or an outline is neither a box nor a polygon.
    """
    if OmegaConf.is_config(given):
        given = OmegaConf.to_container(given)  # type: ignore[arg-type]
    if isinstance(given, str):
        path = user_path(given)
        try:
            given = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise NerfroError(
                f"outlines={path} cannot be read ({error}); give a JSON file of outlines by name"
            ) from error
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
    """All splits' views, each image once, without masks.

    Raises:
        NerfroError: splits have images of several sizes, or the loader does not tell its files.
    """
    parts: list[Cameras] = []
    images: list[UInt8[np.ndarray, "H W 3"]] = []
    frames: list[Frame] = []
    known: set[Path] = set()
    for split in source.splits:
        with masks_left_out():
            views = source.load(split)
        if len(views.frames) != len(views):
            raise NerfroError("this data format does not tell where its images lie; convert it to data=opencv")
        fresh = [i for i, frame in enumerate(views.frames) if frame.image not in known]
        if not fresh:
            continue
        parts.append(views.cameras.select(fresh))
        images += [np.uint8(np.rint(255 * views.images[i].numpy())) for i in fresh]
        frames += [views.frames[i] for i in fresh]
        known |= {views.frames[i].image for i in fresh}
    sizes = {(part.width, part.height) for part in parts}
    if len(sizes) > 1:
        raise NerfroError(f"splits have images of several sizes ({sorted(sizes)}); leave data.eval_crop at 1")
    return _joined(parts), images, frames


def _joined(parts: Sequence[Cameras]) -> Cameras:
    names = ("camera_to_world", "fx", "fy", "cx", "cy")
    tensors: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    lenses = [torch.zeros(len(part), 9) if part.distortion is None else part.distortion for part in parts]
    return replace(parts[0], **tensors, distortion=torch.cat(lenses))


def _find_frame(name: str, frames: list[Frame]) -> int:
    """The frame of a name: as the data set calls it, or its file's name with or without extension."""
    found = [i for i, frame in enumerate(frames) if frame.name == name]
    found = found or [i for i, frame in enumerate(frames) if name in (frame.image.name, frame.image.stem)]
    if len(found) != 1:
        what = "is no image of the data" if not found else f"are {len(found)} images of the data"
        raise NerfroError(f"outlines: {name} {what}; its names are like {frames[0].name}")
    return found[0]


def _check(frames: list[Frame], outlined: Mapping[int, object], kept: Mapping[int, object]) -> None:
    if not outlined and not kept:
        example = f"outlines={{{frames[0].name}:[LEFT,TOP,RIGHT,BOTTOM]}}"
        raise NerfroError(
            f"there is no mask to start from; give the outline of the object in an image, as in {example}"
        )
    for view in outlined:
        if view in kept:
            raise NerfroError(
                f"{frames[view].name} has a mask, {kept[view]}; delete it, or set overwrite=true to make all masks anew"
            )
    if len(kept) == len(frames):
        raise NerfroError("all images have masks; delete those that are wrong, or set overwrite=true")
    repeated = [path for path, count in Counter(_mask_file(frame) for frame in frames).items() if count > 1]
    if repeated:
        raise NerfroError(f"{repeated[0]} would be the mask of two images that differ in extension only; rename one")


def _mask_file(frame: Frame) -> Path:
    """Where a frame's mask is, or goes."""
    return frame.mask or frame.image.with_name(f"mask_{frame.image.stem}.png")


def _stored_size(frame: Frame) -> tuple[int, int]:
    with Image.open(frame.image) as image:
        return image.size


def _read(mask: Path | None, size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    assert mask is not None
    share = read_mask(mask)
    if share.shape[0] * size[0] != share.shape[1] * size[1]:
        raise NerfroError(
            f"mask {mask} has {share.shape[1]}x{share.shape[0]} pixels, of other proportions than its image"
        )
    return opencv().resize(share, size, interpolation=opencv().INTER_AREA) > 0.5


def _png(mask: Bool[np.ndarray, "H W"], size: tuple[int, int]) -> bytes:
    """The mask in its image's size, black and white."""
    image = Image.fromarray(np.uint8(255 * mask))
    if image.size != size:
        image = image.resize(size, Image.Resampling.BICUBIC).point(lambda level: 255 * (level > 127))
    content = io.BytesIO()
    image.save(content, "PNG")
    return content.getvalue()


def _draw_sheet(
    images: list[UInt8[np.ndarray, "H W 3"]],
    frames: list[Frame],
    masks: Mapping[int, Bool[np.ndarray, "H W"]],
    overlaps: Mapping[int, float],
) -> bytes:
    """All views with their masks, darkened outside; the doubtful first, those that were given last."""
    order = sorted(range(len(images)), key=lambda view: overlaps.get(view, 2.0))
    height = round(_TILE * images[0].shape[0] / images[0].shape[1])
    columns = min(_COLUMNS, len(order))
    rows = -(-len(order) // columns)
    sheet = Image.new("RGB", (columns * (_TILE + _GAP) + _GAP, rows * (height + _LINE + _GAP) + _GAP), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for place, view in enumerate(order):
        shown = np.where(masks[view][..., None], images[view], images[view] // 4 + np.array([0, 0, 90], np.uint8))
        left, top = _GAP + place % columns * (_TILE + _GAP), _GAP + place // columns * (height + _LINE + _GAP)
        sheet.paste(Image.fromarray(shown).resize((_TILE, height)), (left, top))
        label = f"{overlaps[view]:.3f}" if view in overlaps else "given"
        draw.text((left, top + height + 2), f"{label}  {frames[view].name[-26:]}", "black", font)
    content = io.BytesIO()
    sheet.save(content, "PNG")
    return content.getvalue()


def _report(frames: list[Frame], overlaps: Mapping[int, float], made: list[int], sheet: Path) -> None:
    print("overlap (intersection over union) of each mask with the hull of the others:")
    for view in sorted(overlaps, key=lambda view: overlaps[view]):
        print(f"  {overlaps[view]:.4f}  {frames[view].name}")
    limit = _DOUBTFUL * float(np.median(list(overlaps.values()) or [0.0]))
    bad = [frames[view].name for view in sorted(overlaps, key=lambda view: overlaps[view]) if overlaps[view] < limit]
    if bad:
        shown = ", ".join(bad[:3]) + (f" and {len(bad) - 3} more" if len(bad) > 3 else "")
        print(f"nerfro: warning: overlap much less than is usual: {shown}; look at them first")
    print(f"wrote {len(made)} masks beside their images (mask_*.png), and {sheet}: look at it")
    print("correct wrong masks in any paint program, or delete them, outline one of them, and run this again")


if __name__ == "__main__":
    main()
