"""Photographs as input of the calibration: size check, luminance, and removal of points seen through the object."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.core.light import to_linear
from nerfro.core.progress import track
from nerfro.data.frames import list_images
from nerfro.data.image_files import IMAGE_SUFFIXES, read_mask, read_rgb, read_size, to_unit
from nerfro.poses.boards import TagDetections

HEIF_SUFFIXES = (".heic", ".heif")
PHOTOGRAPH_SUFFIXES = (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB (ITU-R BT.709)


def list_photographs(folder: Path) -> tuple[list[Path], tuple[int, int]]:
    """List the photographs of a folder by name, with their common width and height in pixels.

    A warning names photographs in HEIC format, which are left out.
    """
    images = list_images(folder, IMAGE_SUFFIXES)
    require_one_of_each_name(images)
    # Other photographs in HEIC format have a converted copy.
    left_out = [file.name for file in one_of_each_pair(list_images(folder, PHOTOGRAPH_SUFFIXES)) if file not in images]
    if left_out:
        warn(
            f"photographs in HEIC format are left out: {first_of(left_out)}; convert them to JPEG, or use "
            "nerfro.reconstruct, which reads them"
        )
    shapes = {image: read_size(image)[:2] for image in images}
    ((size, _),) = Counter(shapes.values()).most_common(1)
    odd = [image for image in images if shapes[image] != size]
    if odd:
        way_out = "rotate or remove this image"
        if shapes[odd[0]] == size[::-1]:
            way_out = "the photographs are portrait and landscape, so remove those of one kind, or rotate their pixels"
        raise NerfroError(
            f"image {odd[0]} has {shapes[odd[0]][0]}x{shapes[odd[0]][1]} pixels, but {len(images) - len(odd)} of "
            f"{len(images)} images have {size[0]}x{size[1]}; all images must have one lens and size: {way_out}"
        )
    for image in track("reading", images):
        read_rgb(image, "drop")  # raises an error for a damaged file before the long work starts
    return images, size


def one_of_each_pair(photographs: Sequence[Path]) -> list[Path]:
    """Leave out photographs in HEIC format beside a photograph of the same name in another format."""
    others = {file.stem for file in photographs if file.suffix.lower() not in HEIF_SUFFIXES}
    return [file for file in photographs if file.suffix.lower() not in HEIF_SUFFIXES or file.stem not in others]


def require_one_of_each_name(photographs: Sequence[Path]) -> None:
    """Refuse photographs of a folder that differ only in their extension.

    Raises:
        NerfroError: two photographs have the same name.
    """
    counts = Counter(file.stem for file in photographs)
    repeated = [stem for stem, count in counts.items() if count > 1]
    if repeated:
        raise NerfroError(f"{photographs[0].parent} contains several images named {repeated[0]}; keep one of each name")


def luminance(image: Path) -> UInt8[np.ndarray, "H W"]:
    """Compute the linear luminance of an image, scaled so that the brightest thousandth of the pixels is white.

    Pixels on an edge average linear light. In sRGB values, edges of bright regions would be detected too far outside:
    by 0.2 to 0.3 pixels for tags.
    """
    light = to_linear(to_unit(read_rgb(image, "drop"))) @ _LUMINANCE
    white = max(float(np.quantile(light, 0.999)), 1 / 255)
    return np.uint8(np.rint(255 * np.minimum(light / white, 1.0)))


def outside_mask(detections: TagDetections, mask: Path | None, labels: Sequence[int] | None = None) -> TagDetections:
    """Remove tags that are seen through the object or overlap the mask of the object."""
    if mask is None or len(detections.tag_ids) == 0:
        return detections
    inside = to_unit(read_mask(mask, labels)) > 0.5
    columns, rows = np.clip(detections.image_points.astype(int), 0, np.array(inside.shape[::-1]) - 1).T
    return detections.select(~detections.of_same_tags(inside[rows, columns]))
