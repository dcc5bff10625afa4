"""Masks, silhouettes of the refractive object and pixels to ignore: where their files lie, and how they are read."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from nerfro.cli import warn
from nerfro.data.base import Views
from nerfro.data.image_files import Levels, read_levels, read_mask, read_size
from nerfro.data.pictures import Pictures
from nerfro.errors import NerfroError, first_of

_SPLIT_FOLDERS = ("train", "val", "test")
# Of masks, the better kept ones first; cameras and networks write either case.
_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")

_left_out: ContextVar[bool] = ContextVar("left_out", default=False)


@contextlib.contextmanager
def masks_left_out() -> Iterator[None]:
    """Data that are loaded within it have no masks, for the tool that makes the missing ones: loaders refuse a part."""
    token = _left_out.set(True)
    try:
        yield
    finally:
        _left_out.reset(token)


def find_mask(root: Path, image: Path, stated: str | None = None) -> Path | None:
    """The file of an image's silhouette, or None where there is none.

    Looked for in this order, `<stem>` the image's name without extension and `<folder>` its folder within the root:
    the stated path; `mask_<stem>.png` beside the image; `masks/<folder>/<stem>.png` or `<stem>.<extension>.png`
    (COLMAP's form) in the root, also without the folder's first part unless that is a split's (`images/a.jpg` has
    `masks/a.png`, but `train/a.png` has only `masks/train/a.png`, for `test/a.png` is another picture). JPEG will do
    where there is no PNG.

    Args:
        root: the data set's folder.
        image: the image's file.
        stated: path within the root that the data set itself gives, if it does; the file must exist.
    """
    if stated is not None:
        mask = root / stated.replace("\\", "/")
        if not mask.is_file():
            raise NerfroError(f"mask {mask} of {image} does not exist; restore it or take its path out of the data set")
        return mask
    candidates = [image.with_name(f"mask_{image.stem}{suffix}") for suffix in _SUFFIXES]
    if image.is_relative_to(root):
        folder = image.relative_to(root).parent
        folders = [folder]
        if folder.parts and folder.parts[0] not in _SPLIT_FOLDERS:
            folders.append(Path(*folder.parts[1:]))
        for within in folders:
            names = [*(f"{image.stem}{suffix}" for suffix in _SUFFIXES), f"{image.name}.png"]
            candidates += [root / "masks" / within / name for name in names]
    return next((path for path in candidates if path.is_file()), None)


def find_masks(
    images: Sequence[Path], masks: Sequence[Path | None], downscale: float, size: tuple[int, int]
) -> Pictures | None:
    """The silhouettes of images; where they have no files, the images' transparency, if they have any.

    Args:
        images: the images' files.
        masks: the silhouettes' files. Where only some images have one, the user is told, and none is taken.
        downscale: how many times smaller they become.
        size: width and height of the images in pixels before downscaling.

    Returns:
        Share of each pixel that the object covers; None where there are no silhouettes.
    """
    if _left_out.get():
        return None
    bare = [image.name for image, mask in zip(images, masks, strict=True) if mask is None]
    if 0 < len(bare) < len(images):
        told = f"{len(bare)} of {len(images)} images have no mask ({first_of(bare)})"
        warn(f"{told}: a hull is made of the others, and nothing is scored on the object alone")
        return None
    if not bare:
        return _of_files(images, masks, read_mask, downscale, size)
    return Pictures.of(images, _read_alpha, downscale) if _is_transparent(images[0]) else None


def masked_views(views: Views) -> Views:
    """The views that have masks, where some have none."""
    chosen = [i for i, frame in enumerate(views.frames) if frame.mask is not None]
    if views.masks is not None or not chosen or not isinstance(views.images, Pictures):
        return views
    frames, pictures = [views.frames[i] for i in chosen], views.images
    files = [frame.image for frame in frames]
    masks = find_masks(files, [frame.mask for frame in frames], pictures.downscale, pictures.size[::-1])
    assert masks is not None
    images = replace(pictures, files=files)
    if pictures.window is not None:
        masks = masks.cut(pictures.window)
    return Views(views.cameras.select(chosen), images, masks, [views.names[i] for i in chosen], frames=frames)


def find_usable(
    images: Sequence[Path], masks: Sequence[Path | None], downscale: float, size: tuple[int, int]
) -> Pictures:
    """Masks that rule pixels out: black ones are ignored, white ones are used, grey ones by the nearer of the two.

    Arguments are those of `find_masks`; every image must have a mask that leaves a pixel. The result is 1 in the pixels
    that are used, less in all others; a block of averaged pixels is used if all of it is.
    """
    usable = _of_files(images, masks, _read_usable, downscale, size)
    for image, mask, levels in zip(images, masks, usable.all_levels(), strict=True):
        if levels.max() < np.iinfo(levels.dtype).max:
            smaller = f" at data.downscale={downscale:g}" if downscale > 1 else ""
            raise NerfroError(
                f"mask {mask} rules out all pixels of {image}{smaller}: black is ignored, white is used; "
                "is it inverted? Correct it or take the frame out"
            )
    return usable


def _of_files(
    images: Sequence[Path],
    masks: Sequence[Path | None],
    read: Callable[[Path], Levels],
    downscale: float,
    size: tuple[int, int],
) -> Pictures:
    files = [mask for mask in masks if mask is not None]
    if len(files) < len(images):
        bare = [str(image) for image, mask in zip(images, masks, strict=True) if mask is None]
        raise NerfroError(
            f"{len(bare)} of {len(images)} images have no mask ({bare[0]} is the first) but others have; "
            "give all of them masks, or none"
        )
    for mask in files:
        width, height, _ = read_size(mask)
        if (width, height) != size:
            raise NerfroError(
                f"mask {mask} has {width}x{height} pixels but its image has {size[0]}x{size[1]}; "
                "make it again for the image as it is"
            )
    return Pictures.of(files, read, downscale)


def _read_usable(mask: Path) -> Levels:
    levels = read_mask(mask)
    most = np.iinfo(levels.dtype).max
    return np.where(levels > most // 2, most, 0).astype(levels.dtype)


def _is_transparent(image: Path) -> bool:
    """Whether an image has pixels that are not opaque; alpha that is 1 everywhere says nothing."""
    try:
        with Image.open(image) as opened:
            if not opened.has_transparency_data:  # known without decoding
                return False
    except OSError:
        return False  # told where the colours are read
    levels = _read_alpha(image)
    return bool((levels < np.iinfo(levels.dtype).max).any())


def _read_alpha(image: Path) -> Levels:
    levels = read_levels(image)
    if levels.shape[-1] in (2, 4):
        return levels[..., -1]
    return np.full(levels.shape[:2], np.iinfo(levels.dtype).max, levels.dtype)
