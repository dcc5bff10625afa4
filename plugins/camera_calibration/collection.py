"""Collection of photographs, frames of a video, and masks in the folder of a data set."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path

from omegaconf import DictConfig
from PIL import ImageOps

from nerfro.data.frames import list_images
from nerfro.data.image_files import IMAGE_SUFFIXES
from nerfro.errors import NerfroError
from nerfro.files.atomic import atomic_file
from nerfro.files.reading import open_image, orientation_of
from nerfro.paths import user_path
from nerfro.progress import track

from .calibrated_data import REPORT
from .photographs import HEIF_SUFFIXES, PHOTOGRAPH_SUFFIXES
from .video import extract_frames

_QUALITY = 95  # of converted photographs
_CONVERTED = b"converted by nerfro from "  # comment of converted photographs, before the path of the original


def collect_photographs(config: DictConfig, out: Path) -> list[Path]:
    """Link the photographs, or the sharpest frames of a video, and the masks into the folder of the data set.

    Args:
        config: the settings `images`, `video`, `frames` and `masks` of `nerfro.reconstruct`.
        out: folder of the data set.

    Returns:
        The linked photographs.
    """
    if config.video is None:
        photographs = user_path(config.images)
    else:
        photographs = out / "frames"
        if not (out / REPORT).is_file():
            extract_frames(user_path(config.video), photographs, config.frames)
    link_photographs(photographs, None if config.masks is None else user_path(config.masks), out)
    return list_images(out / "images")


def link_photographs(photographs: Path, masks: Path | None, out: Path) -> None:
    """Link photographs into `out`/images and masks into `out`/masks, so that no result lies among the originals.

    Photographs in HEIC format and those with an EXIF orientation are converted. Files of the user in these folders are
    kept. Links and converted photographs are made again if their originals are not in the given folders or have
    changed, but after the calibration only links to deleted files and to masks of another folder.

    Args:
        photographs: folder of the photographs, which may also contain masks (`mask_*`).
        masks: folder of the masks, `<name>.png`, `<name>.<extension of the photograph>.png` or `mask_<name>.png`.
        out: folder of the data set.

    Raises:
        NerfroError: a folder does not exist or holds no photograph, or photographs differ only in their extension.
    """
    _require_one_of_each_name(list_images(photographs, PHOTOGRAPH_SUFFIXES))
    if masks is not None and not masks.is_dir():
        raise NerfroError(f"masks={masks} is not a folder; give the folder of the masks of the photographs")
    folders = (photographs, *([] if masks is None else [masks]))
    originals = {file.resolve() for folder in folders for file in folder.iterdir()}
    is_calibrated = (out / REPORT).is_file()
    for placed in (*out.glob("images/*"), *out.glob("masks/*")):
        is_mask = placed.parent.name == "masks" or placed.name.startswith("mask_")
        is_kept = is_calibrated and (masks is None or not is_mask)
        if not placed.exists() or (not is_kept and _is_outdated(placed, originals)):
            placed.unlink()
    for folder in folders:
        suffixes = PHOTOGRAPH_SUFFIXES if folder == photographs else IMAGE_SUFFIXES
        files = (file for file in folder.iterdir() if file.suffix.lower() in suffixes)
        for file in track("linking", sorted(file for file in files if not file.name.startswith("."))):
            among_images = folder == photographs or file.name.startswith("mask_")
            place = out / ("images" if among_images else "masks")
            place.mkdir(parents=True, exist_ok=True)
            if folder == photographs:
                _place_photograph(file, place)
                continue
            # A converted photograph has another extension, so that of the photograph is left out.
            stem = Path(file.stem).stem if (photographs / file.stem).is_file() else file.stem
            if not (link := place / f"{stem}{file.suffix}").exists():
                link.symlink_to(file.resolve())


def _require_one_of_each_name(photographs: Sequence[Path]) -> None:
    """Refuse photographs that differ only in their extension, except a photograph and its converted copy."""
    counts, originals = Counter(file.stem for file in photographs), {file.resolve() for file in photographs}
    several = [file for file in photographs if counts[file.stem] > 1 and _converted_from(file) not in originals]
    repeated = [stem for stem, count in Counter(file.stem for file in several).items() if count > 1]
    if repeated:
        raise NerfroError(f"{several[0].parent} contains several images named {repeated[0]}; keep one of each name")


def _is_outdated(placed: Path, originals: Collection[Path]) -> bool:
    """Test whether a link or a converted photograph follows from none of the originals, or from an older version."""
    if placed.is_symlink():
        return placed.resolve() not in originals
    original = _converted_from(placed)
    if original is None:
        return False
    return original not in originals or original.stat().st_mtime_ns > placed.stat().st_mtime_ns


def _converted_from(file: Path) -> Path | None:
    """Return the original of a photograph that nerfro has converted; None for all other files."""
    if file.suffix != ".jpg" or not file.is_file():
        return None
    with open_image(file, upright=False) as (image, _):
        comment = image.info.get("comment", b"")
    return Path(os.fsdecode(comment.removeprefix(_CONVERTED))) if comment.startswith(_CONVERTED) else None


def _place_photograph(file: Path, folder: Path) -> None:
    """Link a photograph into a folder; one in HEIC format or with an EXIF orientation is converted to an upright JPEG.

    Existing files are kept.
    """
    if file.suffix.lower() in HEIF_SUFFIXES:
        try:
            import pillow_heif
        except ImportError as error:
            raise NerfroError(f"{file} needs pillow-heif; pip install 'nerfro[capture]', or give JPEG files") from error
        pillow_heif.register_heif_opener()
    place, converted = folder / file.name, folder / f"{file.stem}.jpg"
    if place.exists() or converted.exists():
        return
    with open_image(file, upright=False) as (image, _):
        if file.suffix.lower() in HEIF_SUFFIXES or orientation_of(image) in range(2, 9):
            upright = ImageOps.exif_transpose(image).convert("RGB")
            with atomic_file(converted) as output:
                comment = _CONVERTED + os.fsencode(file.resolve())
                upright.save(output, "JPEG", quality=_QUALITY, exif=upright.getexif(), comment=comment)
            return
    place.symlink_to(file.resolve())
