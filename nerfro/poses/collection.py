"""Collection of photographs, sharp frames of a video, and masks in the folder of a data set.

Calibrations check the sizes of photographs, take their luminance, and remove points seen through the object.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from omegaconf import DictConfig
from PIL import ExifTags, Image, ImageOps

from nerfro.core.errors import NerfroError, first_of, optional, warn
from nerfro.core.light import to_linear
from nerfro.core.paths import user_path
from nerfro.core.progress import track
from nerfro.data.frames import list_images
from nerfro.data.image_files import IMAGE_SUFFIXES, read_mask, read_rgb, read_size, to_unit
from nerfro.files.atomic import atomic_file, write_atomically
from nerfro.files.cache import file_hash
from nerfro.files.images import read_16bit
from nerfro.files.reading import open_image, orientation_of
from nerfro.poses.boards import TagDetections
from nerfro.poses.calibrated_data import REPORT
from nerfro.poses.opencv import opencv

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


_VIDEO_RECORD = "video.sha256"  # hash of the video in the folder of its frames
# EXIF data of 16-bit files that are kept; others describe the file.
_KEPT_TAGS = (ExifTags.Base.Orientation, ExifTags.Base.Make, ExifTags.Base.Model)


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
        video = user_path(config.video)
        if not (out / REPORT).is_file():
            extract_frames(video, photographs, config.frames)
        elif video.is_file() and _recorded_video(photographs) not in (None, file_hash(video)):
            raise NerfroError(
                f"out={out} has poses of the frames of another video than video={video}; choose another out=FOLDER"
            )
    link_photographs(photographs, None if config.masks is None else user_path(config.masks), out)
    return list_images(out / "images", IMAGE_SUFFIXES)


def link_photographs(photographs: Path, masks: Path | None, out: Path) -> None:
    """Link photographs into `out`/images and masks into `out`/masks, so that no result lies among the originals.

    Photographs in HEIC format and those with an EXIF orientation are converted. Existing files are kept. Links to
    deleted files are removed. Links to other files of the same name are replaced, those to photographs only before the
    calibration, to which their poses belong. A warning names photographs in `out`/images that `photographs` lacks.

    Args:
        photographs: folder of the photographs, which may also contain masks (`mask_*`).
        masks: folder of the masks, `<name>.png`, `<name>.<extension of the photograph>.png` or `mask_<name>.png`.
        out: folder of the data set.

    Raises:
        NerfroError: a folder does not exist or holds no photograph, or photographs differ only in their extension.
    """
    originals = one_of_each_pair(list_images(photographs, PHOTOGRAPH_SUFFIXES))
    if masks is not None and not masks.is_dir():
        raise NerfroError(f"masks={masks} is not a folder; give the folder of the masks of the photographs")
    is_calibrated = (out / REPORT).is_file()
    if not is_calibrated:
        require_one_of_each_name(originals)
    for link in (*out.glob("images/*"), *out.glob("masks/*")):
        if not link.exists():
            link.unlink()
    (out / "images").mkdir(parents=True, exist_ok=True)
    beside = (file for file in photographs.glob("mask_*") if file.suffix.lower() in IMAGE_SUFFIXES)
    for file in track("linking", sorted([*originals, *beside])):
        _place_photograph(file, out / "images", replaces=not is_calibrated)
    of_folder = [] if masks is None else [file for file in masks.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
    for file in track("linking", sorted(file for file in of_folder if not file.name.startswith("."))):
        target = out / ("images" if file.name.startswith("mask_") else "masks")
        target.mkdir(exist_ok=True)
        # A converted photograph has another extension, so that of the photograph is left out.
        stem = Path(file.stem).stem if (photographs / file.stem).is_file() else file.stem
        _link(target / f"{stem}{file.suffix}", file)
    if not is_calibrated:
        _warn_of_others(originals, out / "images")


def _warn_of_others(given: Sequence[Path], folder: Path) -> None:
    """Warn of photographs in a folder that are not given, or are older than a given photograph of the same name."""
    originals = {file.stem: file for file in given}
    others, outdated = [], []
    for file in list_images(folder, IMAGE_SUFFIXES):
        original = originals.get(file.stem)
        if original is None:
            others.append(file.name)
        elif not file.is_symlink() and file.stat().st_mtime_ns < original.stat().st_mtime_ns:
            outdated.append(file.name)
    for names, what in ((others, "not in"), (outdated, "older than those in")):
        if names:
            warn(
                f"{folder} has photographs that are {what} {given[0].parent}: {first_of(names)}; they are used, so "
                "delete them if they are wrong"
            )


def _links_to_other(link: Path, file: Path) -> bool:
    """Return whether a path is a link to another file than the given one."""
    return link.is_symlink() and link.resolve() != file.resolve()


def _link(link: Path, file: Path) -> None:
    """Link a file, unless there is another file of the name; replaces a link to another file."""
    if _links_to_other(link, file):
        link.unlink()
    if not link.exists():
        link.symlink_to(file.resolve())


def _place_photograph(file: Path, folder: Path, replaces: bool) -> None:
    """Link a photograph into a folder; one in HEIC format or with an EXIF orientation is converted to an upright JPEG.

    Args:
        file: photograph.
        folder: folder of the link or of the converted photograph, whose existing files are kept.
        replaces: whether to replace a link to another file.
    """
    if file.suffix.lower() in HEIF_SUFFIXES:
        pillow_heif = optional("pillow_heif", "capture", f"{file} needs pillow-heif", ", or give JPEG files")
        pillow_heif.register_heif_opener()
    link, converted = folder / file.name, folder / f"{file.stem}.jpg"
    for existing in (link, converted):
        if existing.exists() and not (replaces and _links_to_other(existing, file)):
            return
        existing.unlink(missing_ok=True)
    with open_image(file, upright=False) as (image, bits):
        if file.suffix.lower() in HEIF_SUFFIXES or orientation_of(image) in range(2, 9):
            upright = ImageOps.exif_transpose(_as_stored(file, image, bits)).convert("RGB")
            with atomic_file(converted) as output:
                upright.save(output, "JPEG", quality=95, exif=upright.getexif())
            return
    link.symlink_to(file.resolve())


def _as_stored(file: Path, image: Image.Image, bits: int) -> Image.Image:
    """Return a photograph in the orientation of its file, with 8 bits per channel and its EXIF data."""
    if bits <= 8:
        return image
    levels = read_16bit(file)  # Pillow clips 16-bit grey levels
    colours = levels[..., 0] if levels.shape[-1] < 3 else levels[..., :3]
    stored = Image.fromarray(np.uint8(np.rint(255 * to_unit(colours))))
    exif, given = Image.Exif(), Image.Image.getexif(image)
    exif.update({tag: given[tag] for tag in _KEPT_TAGS if tag in given})
    exif.get_ifd(ExifTags.IFD.Exif).update(given.get_ifd(ExifTags.IFD.Exif))  # the focal length, among others
    stored.info["exif"] = exif.tobytes()
    return stored


def extract_frames(video: Path, folder: Path, count: int) -> list[Path]:
    """Write the sharpest frame of each of `count` equal parts of a video as `frame_NNNNN.jpg`.

    The number in the name is the number of the frame in the video. Frames that exist are kept, so that an interrupted
    extraction resumes. Frames of another video or of another `count` are deleted; the folder records a hash of
    the video.

    Args:
        video: file in any format that OpenCV's FFmpeg reads; its rotation is applied.
        folder: output folder.
        count: number of frames, at least 2.

    Returns:
        The files, in the order of the video.

    Raises:
        NerfroError: the file cannot be read, or has fewer than `count` frames.
    """
    sharpness = _sharpness(video)
    if len(sharpness) < count:
        raise NerfroError(
            f"{video} has {len(sharpness)} readable frames, and frames={count} are asked for; record a longer video, "
            "or reduce frames="
        )
    edges = np.linspace(0, len(sharpness), count + 1).round().astype(int)
    sharpest = {int(first + sharpness[first:last].argmax()) for first, last in itertools.pairwise(edges)}
    files = {number: folder / f"frame_{number:05d}.jpg" for number in sorted(sharpest)}
    folder.mkdir(parents=True, exist_ok=True)
    content = file_hash(video)
    is_same = _recorded_video(folder) == content
    for file in folder.glob("frame_*.jpg"):
        if file not in files.values() or not is_same:
            file.unlink()
    write_atomically(folder / _VIDEO_RECORD, f"{content}\n")
    waiting = {number for number, file in files.items() if not file.is_file()}
    for number, frame in enumerate(_frames(video) if waiting else ()):
        if number in waiting:
            _, encoded = opencv().imencode(".jpg", frame, [opencv().IMWRITE_JPEG_QUALITY, 95])
            write_atomically(files[number], encoded.tobytes())
            waiting.remove(number)
        if not waiting:
            break
    return list(files.values())


def _recorded_video(folder: Path) -> str | None:
    """Return the hash of the video that a folder of frames records; None without a record."""
    record = folder / _VIDEO_RECORD
    return record.read_text("utf-8", errors="replace").strip() if record.is_file() else None


def _sharpness(video: Path) -> Float[np.ndarray, "F"]:
    """Compute the variance of the Laplacian of each frame, which motion blur reduces."""
    cv2, values = opencv(), []
    capture = _open(video)
    total = int(max(0.0, capture.get(cv2.CAP_PROP_FRAME_COUNT)))
    capture.release()
    for frame in track("finding sharp frames", _frames(video), total=total or None):
        # Sharpness is measured on frames of at most 480 pixels per side.
        scale = min(1.0, 480 / max(frame.shape[:2]))
        size = math.ceil(frame.shape[1] * scale), math.ceil(frame.shape[0] * scale)
        grey = cv2.cvtColor(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
        values.append(float(cv2.Laplacian(grey, cv2.CV_64F).var()))
    return np.array(values)


def _open(video: Path) -> Any:
    """Open a video for decoding."""
    if not video.is_file():
        raise NerfroError(f"video={video} does not exist; give a video file, or images=FOLDER for photographs")
    capture = opencv().VideoCapture(str(video), opencv().CAP_FFMPEG)
    if not capture.isOpened():
        raise NerfroError(f"video={video} cannot be read; give a video file such as .mp4 or .mov")
    return capture


def _frames(video: Path) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Decode a video, BGR."""
    capture = _open(video)
    try:
        while True:
            succeeded, frame = capture.read()
            if not succeeded:
                return
            yield frame
    finally:
        capture.release()
