"""Masks: search and read silhouettes of the refractive object, and masks of pixels to ignore."""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.data.base import SPLITS, DataSource, Views
from nerfro.data.image_files import IMAGE_SUFFIXES, Levels, is_linear, read_levels, read_mask, read_size
from nerfro.data.lazy_images import LazyImages
from nerfro.files.reading import as_spelled, open_image, unicode_forms

# Lossless format first. Cameras and networks write suffixes in lower or upper case.
_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")

# Key of the text in the PNG file of a mask that nerfro made: the method and a checksum of the pixels. The method is the
# shape whose projection the mask is, POLYGON for an outline, or TRACKED for Segment Anything 2.
METHOD, POLYGON, TRACKED, REVOLUTION = "nerfro", "polygon", "sam2", "body of revolution"
EVIDENCE = (None, POLYGON, TRACKED)  # methods whose masks show the object in the photograph

_ignore_masks: ContextVar[bool] = ContextVar("ignore_masks", default=False)


@contextlib.contextmanager
def without_masks() -> Iterator[None]:
    """Load data sets without masks inside this context. The masking command uses this while masks are incomplete."""
    token = _ignore_masks.set(True)
    try:
        yield
    finally:
        _ignore_masks.reset(token)


def checksum(image: Image.Image) -> int:
    return zlib.crc32(np.asarray(image).tobytes())


def method_of(mask: Path) -> str | None:
    """Return the method with which nerfro made a mask; None if the file states no method, or was edited since.

    The method is the shape whose projection the mask is, POLYGON or TRACKED. Masks by GrabCut state no method.
    """
    with open_image(mask) as (image, _):
        method, _, expected = str(image.info.get(METHOD, "")).partition(":")
        return method if expected and expected == str(checksum(image)) else None


def find_mask(root: Path, image: Path, stated: str | None = None) -> Path | None:
    """Find the silhouette of an image.

    The first existing file is used, where `<stem>` is the image's name without extension and `<folder>` is its folder
    within the root. PNG is preferred to JPEG.

    1. the stated path;
    2. `mask_<stem>.png` beside the image;
    3. `masks/<folder>/<stem>.png` or `masks/<folder>/<stem>.<extension>.png` (COLMAP's convention);
    4. the same without the first component of `<folder>`, unless this is the name of a split. For example,
       `images/a.jpg` may use `masks/a.png`, but `train/a.png` may not, because `test/a.png` is another image.

    Args:
        root: folder of the data set.
        image: the image file.
        stated: path of the silhouette within the root as stated by the data set, if any. The file must exist.

    Returns:
        The file, or None if there is no silhouette.
    """
    if stated is not None:
        mask = as_spelled(root, stated.replace("\\", "/"))
        if not os.path.isfile(mask):  # False for a name that is too long
            raise NerfroError(f"mask {mask} of {image} does not exist; restore it or remove its path from the data set")
        return mask
    if (beside := mask_beside(image)) is not None or not image.is_relative_to(root):
        return beside
    first, *rest = image.relative_to(root).parent.parts or ("",)
    folders = [Path(first, *rest)] if first in SPLITS else [Path(first, *rest), Path(*rest)]
    names = [*(f"{image.stem}{suffix}" for suffix in _SUFFIXES), f"{image.name}.png"]
    masks = ((folder / name).as_posix() for folder in folders for name in names)
    candidates = (root / "masks" / form for mask in masks for form in unicode_forms(mask))
    return next((path for path in candidates if path.is_file()), None)


def mask_beside(image: Path) -> Path | None:
    """Return the file `mask_<stem>.png` beside an image, where `nerfro.mask` writes; None if it does not exist."""
    candidates = (image.with_name(f"mask_{image.stem}{suffix}") for suffix in _SUFFIXES)
    return next((path for path in candidates if path.is_file()), None)


def unused_masks(root: Path, images: Sequence[Path], masks: Sequence[Path | None]) -> list[Path]:
    """List the files at the usual places of masks if no image has a mask; otherwise, return an empty list.

    The arguments are those of `require_used`.
    """
    if any(masks) or _ignore_masks.get():
        return []
    beside = (path for folder in {image.parent for image in images} for path in folder.glob("mask_*"))
    below = root.glob("[mM][aA][sS][kK][sS]/**/*")
    files = {path for path in (*beside, *below) if path.suffix.lower() in IMAGE_SUFFIXES}
    return sorted(path for path in files.difference(images) if path.is_file() and not path.name.startswith("."))


def require_used(root: Path, images: Sequence[Path], masks: Sequence[Path | None]) -> None:
    """Refuse a data set whose mask files belong to no image.

    Args:
        root: folder of the data set.
        images: all image files.
        masks: mask files of the images.

    Raises:
        NerfroError: there are mask files, but no image has a mask.
    """
    unused = unused_masks(root, images, masks)
    if unused:
        raise NerfroError(
            f"no image has a mask, although {first_of([*map(str, unused)])} exist: the mask of {images[0]} has another "
            "place or name, and one file is never the mask of several images; rename the masks as "
            "docs/guides/data_formats.md describes, or move them out of the folder"
        )


def find_masks(
    images: Sequence[Path],
    masks: Sequence[Path | None],
    downscale: float,
    size: tuple[int, int],
    labels: Sequence[int] | None = None,
) -> LazyImages | None:
    """Load the silhouettes of images; without silhouette files, the transparency of the images is used.

    Args:
        images: image files.
        masks: silhouette files. If only some images have one, none is used, with a warning.
        downscale: downscaling factor, 1 or more.
        size: stored width and height of the images in pixels.
        labels: labels of the object, see `read_mask`.

    Returns:
        Coverage of each pixel by the object in [0, 1], or None if there are no silhouettes.
    """
    if _ignore_masks.get():
        return None
    unmasked = [image.name for image, mask in zip(images, masks, strict=True) if mask is None]
    if 0 < len(unmasked) < len(images):
        warn(
            f"{len(unmasked)} of {len(images)} images have no mask ({first_of(unmasked)}): the visual hull uses the "
            "others, and no scores of the object alone are computed"
        )
        return None
    if not unmasked:
        return _of_files(images, masks, lambda mask: read_mask(mask, labels), downscale, size)
    return LazyImages.of(images, _read_alpha, downscale) if _any_is_transparent(images) else None


def masked_views(views: Views) -> Views:
    """Select the views that have mask files, if only some views have one; otherwise, return all views."""
    with_mask = [i for i, frame in enumerate(views.frames) if frame.mask is not None]
    if views.masks is not None or not with_mask or not isinstance(views.images, LazyImages):
        return views
    some, images = views.select(with_mask), views.images
    files, masks = zip(*((frame.image, frame.mask) for frame in some.frames), strict=True)
    read = find_masks(files, masks, images.downscale, images.size[::-1], views.mask_labels)
    return replace(some, masks=read if read is None or images.window is None else read.cut(images.window))


def with_other_splits(views: Views, source: DataSource, split: str) -> Views:
    """Append the views of all other splits that have masks, each image once, if their images have the same size.

    Views are left out if their mask is empty and was made by nerfro (a projection, a polygon or a mask of Segment
    Anything 2, see `method_of`), because they do not show the object.
    """
    for other in source.splits:
        if other == split:
            continue
        more, images = masked_views(source.load(other)), {frame.image for frame in views.frames}
        fresh = [i for i, frame in enumerate(more.frames) if frame.image not in images]
        joined = views.joined(more.select(fresh)) if fresh else None
        views = views if joined is None else joined
    masks = views.masks
    if masks is None:
        return views
    derived = [i for i, frame in enumerate(views.frames) if frame.mask and method_of(frame.mask) is not None]
    without = {i for i in derived if not masks[i].any()}
    if not without:
        return views
    print(f"views that do not show the object: {first_of([views.names[i] for i in sorted(without)])}")
    return views.select([i for i in range(len(views)) if i not in without])


def find_usable(
    images: Sequence[Path], masks: Sequence[Path | None], downscale: float, size: tuple[int, int]
) -> LazyImages:
    """Load masks of the pixels to ignore (black) and to use (white); grey counts as the nearer of both.

    The arguments are those of `find_masks`, but every image must have a mask that leaves at least one pixel.

    Returns:
        Images that are 1 in usable pixels and less than 1 in all others. After downscaling, a pixel is usable if its
        whole area is.
    """
    usable = _of_files(images, masks, _read_usable, downscale, size)
    for image, mask, levels in zip(images, masks, usable.all_levels(), strict=True):
        if levels.max() < np.iinfo(levels.dtype).max:
            scale = f" at data.downscale={downscale:g}" if downscale > 1 else ""
            raise NerfroError(
                f"mask {mask} excludes all pixels of {image}{scale}: black pixels are ignored, white pixels are used; "
                "invert the mask or remove the frame"
            )
    return usable


def _of_files(
    images: Sequence[Path],
    masks: Sequence[Path | None],
    read: Callable[[Path], Levels],
    downscale: float,
    size: tuple[int, int],
) -> LazyImages:
    files = [mask for mask in masks if mask is not None]
    if len(files) < len(images):
        unmasked = [str(image) for image, mask in zip(images, masks, strict=True) if mask is None]
        raise NerfroError(
            f"{len(unmasked)} of {len(images)} images have no mask ({unmasked[0]} is the first); "
            "give masks for all images or for none"
        )
    for mask in files:
        width, height, _ = read_size(mask)
        if (width, height) != size:
            raise NerfroError(
                f"mask {mask} has {width}x{height} pixels but its image has {size[0]}x{size[1]}; "
                "create it again in the size of the image"
            )
    return LazyImages.of(files, read, downscale)


def _read_usable(mask: Path) -> Levels:
    levels = read_mask(mask)
    most = np.iinfo(levels.dtype).max
    return np.where(levels > most // 2, most, 0).astype(levels.dtype)


def _any_is_transparent(images: Sequence[Path]) -> bool:
    """Return whether any image has pixels that are not opaque; only files that may have such pixels are decoded."""
    files = []
    for path in images:
        if is_linear(path):
            continue
        with open_image(path) as (image, _):
            if image.has_transparency_data:
                files.append(path)
    alphas = LazyImages.of(files, _read_alpha).all_levels() if files else ()
    return any(bool((levels < np.iinfo(levels.dtype).max).any()) for levels in alphas)


def _read_alpha(image: Path) -> Levels:
    if is_linear(image):  # its transparency is no mask
        width, height, _ = read_size(image)
        return np.full((height, width), 255, np.uint8)
    levels = read_levels(image)
    if levels.shape[-1] in (2, 4):
        return levels[..., -1]
    return np.full(levels.shape[:2], np.iinfo(levels.dtype).max, levels.dtype)
