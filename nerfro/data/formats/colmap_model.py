"""Reader of COLMAP reconstructions, text or binary (https://colmap.github.io/format.html).

pycolmap is not used because version 4.2 accepts a truncated cameras.bin silently and runs out of memory on a truncated
points3D.bin. Features are skipped.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float, Int

from nerfro.core.errors import NerfroError, warn
from nerfro.core.lens import coefficients, opencv_coefficients
from nerfro.data.lenses import Lens
from nerfro.files.reading import MAX_ARRAY_BYTES, read_text

# Name and number of parameters of each camera model; the index is the model's identifier in binary files.
CAMERA_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)
_NUM_PARAMS = dict(CAMERA_MODELS)
# Usual places of models below the folder of a data set, in the order of the search. COLMAP numbers the models of
# photographs that it cannot connect: sparse/0, sparse/1.
MODEL_FOLDERS = ("sparse", "colmap/sparse", "")


Point = tuple[tuple[float, ...], Int[np.ndarray, " track"]]
"""Position of a 3-D point, and the identifiers of the images that have observed it."""


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics: name of the camera model, image size in pixels and parameters of the model."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """A registered image: identifier, path within the image folder, camera identifier and pose with OpenCV axes."""

    number: int
    name: str
    camera: int
    camera_to_world: Float[np.ndarray, "3 4"]


@dataclass(frozen=True)
class ColmapModel:
    """A reconstruction.

    Attributes:
        cameras: cameras by identifier.
        images: images sorted by name.
        points: positions of the 3-D points, world units.
        observed, observing: index of the point and identifier of the image of each observation.
    """

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: Float[np.ndarray, "points 3"]
    observed: Int[np.ndarray, " observations"]
    observing: Int[np.ndarray, " observations"]

    def seen_by(self, image: ColmapImage) -> Float[np.ndarray, "seen 3"]:
        """Return the points that an image has observed."""
        return self.points[np.unique(self.observed[self.observing == image.number])]


def find_model_folder(folders: Iterable[Path]) -> Path | None:
    """Return the folder of the model in the first of some folders that contains one, itself or in numbered folders.

    Of several models, the one with the most images is used, and a line says so.
    """
    for folder in folders:
        numbered = sorted((path for path in folder.glob("[0-9]*") if path.name.isdecimal()), key=lambda p: int(p.name))
        models = [path for path in (*numbered, folder) if _holds_model(path)]
        if len(models) > 1:
            counts = {path: _num_images(path) for path in models}
            largest = max(models, key=lambda path: counts[path])
            sizes = ", ".join(f"{path} ({count} images)" for path, count in counts.items())
            warn(f"there are {len(models)} COLMAP models: {sizes}; {largest} is used, which has the most images")
            return largest
        if models:
            return models[0]
    return None


def _holds_model(folder: Path) -> bool:
    """Test whether a folder contains the file cameras.bin or cameras.txt."""
    return any((folder / name).is_file() for name in ("cameras.bin", "cameras.txt"))


def _num_images(folder: Path) -> int:
    """Count the registered images of a model; 0 if it cannot be read."""
    try:
        return len(read_colmap(folder).images)
    except NerfroError:
        return 0


def read_colmap(folder: Path) -> ColmapModel:
    """Read and check a model.

    Args:
        folder: folder with cameras, images and optionally points3D, all as .bin or all as .txt files.

    Raises:
        NerfroError: a file is missing, truncated or inconsistent.
    """
    suffix = next(
        (s for s in _READERS if all((folder / f"{part}{s}").is_file() for part in ("cameras", "images"))), None
    )
    if suffix is None:
        raise NerfroError(f"{folder} holds no cameras and images (.bin or .txt); give the folder of a COLMAP model")
    read_cameras, read_images, read_points = _READERS[suffix]
    cameras = dict(read_cameras(folder / f"cameras{suffix}"))
    images = sorted(read_images(folder / f"images{suffix}"), key=lambda image: image.name)
    path = folder / f"points3D{suffix}"
    rows = list(read_points(path)) if path.is_file() else []
    points = np.array([position for position, _ in rows], dtype=np.float64).reshape(-1, 3)
    observed = np.repeat(np.arange(len(rows)), np.array([len(track) for _, track in rows], np.int64))
    observing = np.concatenate([np.empty(0, np.int64), *(track for _, track in rows)])
    if not images:
        raise NerfroError(f"{folder / f'images{suffix}'} holds no registered image; repeat the reconstruction")
    for one, other in pairwise(images):
        if one.name == other.name:
            raise NerfroError(f"{folder}: two images have the name {one.name}; keep one of them")
    for image in images:
        if image.camera not in cameras:
            raise NerfroError(f"{folder}: image {image.name} has camera {image.camera}, which the model does not hold")
    return ColmapModel(cameras, images, points, observed, observing)


class _Binary:
    """Sequential reader of a little-endian binary file. Reading past the end raises an error."""

    def __init__(self, path: Path) -> None:
        self.path, self.content, self.offset = path, path.read_bytes(), 0

    def take(self, layout: str) -> tuple:
        """Read the next values; `layout` is a format of `struct`."""
        size = struct.calcsize("<" + layout)
        self.skip(size)
        return struct.unpack_from("<" + layout, self.content, self.offset - size)

    def skip(self, size: int) -> None:
        self.offset += size
        if self.offset > len(self.content):
            raise NerfroError(f"{self.path} is truncated; copy or export it again")

    def name(self) -> str:
        end = self.content.find(b"\0", self.offset)
        text = self.content[self.offset : end]
        self.skip(len(text) + 1 if end >= 0 else len(self.content))
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError as error:
            raise NerfroError(f"{self.path} holds a name that is not UTF-8; export it again") from error

    def items(self) -> Iterator[int]:
        """Iterate over the number of items, and check that the file ends after the last item."""
        (count,) = self.take("Q")
        yield from range(count)
        if self.offset != len(self.content):
            raise NerfroError(f"{self.path} continues after its last item: it is corrupt or of an unsupported version")


def _binary_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    file = _Binary(path)
    for _ in file.items():
        number, model, width, height = file.take("iiQQ")
        if not 0 <= model < len(CAMERA_MODELS):
            raise NerfroError(f"{path}: camera model {model} is unknown; undistort the images with COLMAP first")
        name, num_params = CAMERA_MODELS[model]
        yield number, _camera(name, width, height, file.take(f"{num_params}d"), f"{path}: camera {number}")


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    file = _Binary(path)
    for _ in file.items():
        values = file.take("i4d3di")
        name = file.name()
        (num_features,) = file.take("Q")
        file.skip(24 * num_features)  # x, y and identifier of the 3-D point
        yield _image(values[0], name, values[1:5], values[5:8], values[8], path)


def _binary_points(path: Path) -> Iterator[Point]:
    file = _Binary(path)
    for _ in file.items():
        values = file.take("Q3d3BdQ")
        start = file.offset
        file.skip(8 * values[-1])  # track: pairs of image and feature
        yield values[1:4], np.frombuffer(file.content, "<i4", 2 * values[-1], start)[::2].astype(np.int64)


def _text_rows(
    path: Path, form: str, parsers: tuple[Callable[[str], Any], ...], features: bool = False
) -> Iterator[tuple[str, list[Any]]]:
    """Yield location and parsed words of each line that is not a comment.

    Args:
        path: the text file.
        form: format of a line, for the error message.
        parsers: one per word; the last parser receives the rest of the line.
        features: whether a line of features, which may be empty, follows each line.
    """
    lines = read_text(path, "export it again", MAX_ARRAY_BYTES).splitlines()
    numbered = ((i, line.strip()) for i, line in enumerate(lines, 1) if not line.startswith("#"))
    for i, line in numbered:
        if not line:
            continue
        try:
            values = line.split(maxsplit=len(parsers) - 1)
            words = [parse(value) for parse, value in zip(parsers, values, strict=True)]
        except ValueError as error:
            raise NerfroError(f"{path}, line {i} is not {form}: {line[:60]!r}") from error
        yield f"{path}, line {i}", words
        # A line of features ends with a whole number, and a line of an image with its name.
        seen = next(numbered, (0, ""))[1].split() if features else []
        if len(seen) % 3 != 0 or not all(word.removeprefix("-").isdecimal() for word in seen[-1:]):
            raise NerfroError(f"{path}: after line {i} there is no line of features, which may be empty; add the line")


def _text_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    parsers = (int, str, int, int, lambda words: tuple(map(float, words.split())))
    form = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
    for where, (number, model, width, height, params) in _text_rows(path, form, parsers):
        yield number, _camera(model, width, height, params, where)


def _text_images(path: Path) -> Iterator[ColmapImage]:
    parsers, form = (int, *[float] * 7, int, str), "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    for _, (number, *pose, camera, name) in _text_rows(path, form, parsers, features=True):
        yield _image(number, name, tuple(pose[:4]), tuple(pose[4:]), camera, path)


def _text_points(path: Path) -> Iterator[Point]:
    def point(words: str) -> Point:
        (x, y, z), track = map(float, words.split()[:3]), words.split()[7::2]  # after a colour and an error
        return (x, y, z), np.array(track, np.int64)

    return (row for _, (_, row) in _text_rows(path, "POINT3D_ID X Y Z ...", (str, point)))


def _camera(model: str, width: int, height: int, params: tuple[float, ...], where: str) -> ColmapCamera:
    if model in _NUM_PARAMS and len(params) != _NUM_PARAMS[model]:
        raise NerfroError(f"{where}: {model} has {_NUM_PARAMS[model]} parameters, not {len(params)}; export it again")
    # The first parameter of every model is a focal length.
    if width < 1 or height < 1 or not np.isfinite(params).all() or min(params[:1], default=1) <= 0:
        raise NerfroError(
            f"{where}: size {width}x{height} and parameters {params} are not valid; export the model again"
        )
    return ColmapCamera(model, width, height, params)


def _image(
    number: int, name: str, quaternion: tuple[float, ...], shift: tuple[float, ...], camera: int, path: Path
) -> ColmapImage:
    norm = float(np.linalg.norm(quaternion))
    if not (np.isfinite(norm) and np.isfinite(shift).all()) or abs(norm - 1) > 1e-3:
        raise NerfroError(f"{path}: image {name} has no valid pose (quaternion {quaternion}); export the model again")
    # COLMAP stores world-to-camera poses, with the scalar part of the quaternion first.
    inverse = scipy.spatial.transform.Rotation.from_quat([*quaternion[1:], quaternion[0]]).inv()
    return ColmapImage(number, name, camera, np.column_stack([inverse.as_matrix(), -inverse.apply(shift)]))


_READERS = {
    ".bin": (_binary_cameras, _binary_images, _binary_points),
    ".txt": (_text_cameras, _text_images, _text_points),
}


def lens_of(camera: ColmapCamera, where: str) -> Lens:
    """Convert the intrinsics of a perspective COLMAP camera; both use the same pixel coordinates."""
    p = camera.params
    if camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        return Lens(p[0], p[0], p[1], p[2], coefficients(p[3:]))
    if camera.model in ("PINHOLE", "OPENCV", "FULL_OPENCV"):
        return Lens(p[0], p[1], p[2], p[3], opencv_coefficients(p[4:]))
    raise NerfroError(
        f"{where} has the model {camera.model}, which is not supported; undistort the images with "
        "`colmap image_undistorter`, or reconstruct with PINHOLE, RADIAL, OPENCV or FULL_OPENCV"
    )
