"""Collection of photographs, frames of a video, and masks in the folder of a data set."""

from __future__ import annotations

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

    Existing links and files are kept, except links to deleted files. Photographs in HEIC format and those with an EXIF
    orientation are converted.

    Args:
        photographs: folder of the photographs, which may also contain masks (`mask_*`).
        masks: folder of the masks, `<name>.png`, `<name>.<extension of the photograph>.png` or `mask_<name>.png`.
        out: folder of the data set.
    """
    list_images(photographs, PHOTOGRAPH_SUFFIXES)  # raises an error for a folder without photographs
    for link in (*out.glob("images/*"), *out.glob("masks/*")):
        if not link.exists():
            link.unlink()
    for folder in (photographs, *([] if masks is None else [masks])):
        if not folder.is_dir():
            raise NerfroError(f"masks={folder} is not a folder; give the folder of the masks of the photographs")
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
                upright.save(output, "JPEG", quality=_QUALITY, exif=upright.getexif())
            return
    place.symlink_to(file.resolve())
