"""Lenses of cameras: keys in transforms files, and checks for all data formats."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge, Gt, Le, Lt
from jaxtyping import Float
from torch import Tensor

from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.core.lens import coefficients, distort, opencv_coefficients, undistort
from nerfro.files.reading import is_number, parse_matrix
from nerfro.registry.allowed import Positive, check

# Perspective lenses in the files of nerfstudio, COLMAP and Blender. They differ in the coefficients that are zero.
_PERSPECTIVE = ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE", "PERSP")
_MODEL = ("camera_model", "camera_type", "lens_model", "projection", "projection_type")
# Other projections, as keys or as values of `camera_model`.
_PROJECTIONS = re.compile("fish_?eye|ortho|equirect|equidist|lat_?long|panoram|omni|spheric|cylind|f_?theta", re.I)
_STATES_PROJECTION = re.compile("camera|lens|model|projection|type")
# Keys of other projections, and other names of what `_NUMBERS` states; without underscores, in lower case.
_OTHER = re.compile(
    rf"{_PROJECTIONS.pattern}|rolling|skew|^sk[xy]$|fov|focal|intrinsic|principal|cameramat|cammatrix|cameraangle|"
    r"(?<!un)distort|distcoef|pixelaspect|^shift[xy]$|^[cf]l?[xy]?$|^[dkp]\d*$"
)
# Arguments of `coefficients`: numerator, tangential and denominator.
_COEFFICIENTS = (("k1", "k2", "k3", "k4"), ("p1", "p2"), ("q1", "q2", "q3"))
_NAMES = (*_COEFFICIENTS[0], "k5", "k6", *_COEFFICIENTS[1])
_NUMBERS = {
    **dict.fromkeys(("w", "h"), Annotated[float, Ge(1), Le(10**6)]),  # pixels
    **dict.fromkeys(("fl_x", "fl_y"), Positive),
    **dict.fromkeys(("camera_angle_x", "camera_angle_y"), Annotated[float, Gt(0), Lt(math.pi)]),
    **dict.fromkeys(("x_fov", "y_fov"), Annotated[float, Gt(0), Lt(180)]),
    **dict.fromkeys(("cx", "cy", *_NAMES), float),
}


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a perspective camera with lens distortion.

    Attributes:
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels; the corner of the image is at (0, 0).
        distortion: nine coefficients (see `nerfro.core.lens.coefficients`), or None.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] | None = None

    @classmethod
    def of_angle(cls, angle: float, width: int, height: int) -> Lens:
        """Return the ideal lens with a horizontal field of view in radians and a centred principal point."""
        focal = 0.5 * width / math.tan(0.5 * angle)
        return cls(focal, focal, 0.5 * width, 0.5 * height)

    @classmethod
    def of_matrix(cls, matrix: Float[np.ndarray, "3 3"], where: str, max_skew: float = 1e-6) -> Lens:
        """Return the ideal lens of a camera matrix whose skew is at most `max_skew` times the focal length.

        Raises:
            NerfroError: the matrix has skew, or its last row is not 0, 0, 1.
        """
        focal = np.abs(np.diag(matrix)[:2]).max()
        if max(abs(matrix[0, 1]), abs(matrix[1, 0])) > max_skew * focal or np.abs(matrix[2] - [0, 0, 1]).max() > 1e-6:
            raise NerfroError(f"{where} must have no skew and the last row 0, 0, 1; it is {matrix.tolist()}")
        fx, fy, cx, cy = (float(matrix[entry]) for entry in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return cls(fx, fy, cx, cy)

    def resized(self, calibrated: tuple[float, float], size: tuple[int, int], where: str) -> Lens:
        """Scale the intrinsics to images that were resized after the calibration.

        Args:
            calibrated: width and height in pixels that the intrinsics belong to.
            size: width and height in pixels of the images.
            where: subject of the error message.

        Raises:
            NerfroError: the aspect ratios differ.
        """
        by_width, by_height = size[0] / calibrated[0], size[1] / calibrated[1]
        if abs(by_width - by_height) > 1.5 * max(1 / calibrated[0], 1 / calibrated[1]):
            raise NerfroError(
                f"{where} is calibrated for {calibrated[0]:g}x{calibrated[1]:g} pixels but the images have "
                f"{size[0]}x{size[1]} and another aspect ratio; restore the images that were calibrated"
            )
        return Lens(self.fx * by_width, self.fy * by_height, self.cx * by_width, self.cy * by_height, self.distortion)


def read_lens(file: Mapping[str, Any], frame: Mapping[str, Any], size: tuple[int, int], where: str) -> Lens:
    """Read the lens of a frame from the keys of a transforms file; docs/guides/data_formats.md lists the keys.

    A key of the frame takes precedence over the file, and a focal length over a field of view.

    Args:
        file: keys of the file.
        frame: keys of the frame.
        size: width and height in pixels of the image as stored.
        where: subject of the error message.

    Raises:
        NerfroError: a key has a wrong value, names another projection, or no key states the focal length.
    """
    models = [_model(level, where) for level in (frame, file)]
    levels = [_numbers(level, "FULL_OPENCV" in (models[0] or models[1] or ""), where) for level in (frame, file)]
    values = levels[1] | levels[0]
    calibrated = values.get("w", size[0]), values.get("h", size[1])
    fx, fy = _focal_lengths(levels[0], levels[1], calibrated, where)
    centre = values.get("cx", 0.5 * calibrated[0]), values.get("cy", 0.5 * calibrated[1])
    if all(0 < value <= 1 for value in centre) and min(calibrated) >= 8:
        raise NerfroError(f"{where}: cx={centre[0]:g} and cy={centre[1]:g} seem to be fractions; give pixels")
    groups = [[values.get(name, 0.0) for name in names] for names in _COEFFICIENTS]
    return Lens(fx, fy, *centre, coefficients(*groups)).resized(calibrated, size, where)


def _model(level: Mapping[str, Any], where: str) -> str | None:
    """Return the perspective lens that the file or a frame names, if any; refuse keys of other projections."""
    for key, value in level.items():
        plain = re.sub(r"[\W_]", "", key).lower()
        names_other = isinstance(value, str) and _STATES_PROJECTION.search(plain) and _PROJECTIONS.search(value)
        if (names_other or _OTHER.search(plain)) and key not in _NUMBERS and not _says_nothing(value):
            raise NerfroError(
                f"{where}: {key}={value!r} is not supported; undistort the images, state a perspective lens by fl_x, "
                "fl_y, cx, cy, k1, k2, k3, p1 and p2, or remove the key if it says nothing about the lens"
            )
    stated = [(key, level[key]) for key in _MODEL if level.get(key) is not None]
    for key, model in stated:
        if str(model).upper() not in _PERSPECTIVE:
            raise NerfroError(
                f"{where}: {key}={model!r} is not supported; undistort the images to one of {', '.join(_PERSPECTIVE)}, "
                "for example with COLMAP's image_undistorter"
            )
    return str(stated[0][1]).upper() if stated else None


def _says_nothing(value: Any) -> bool:
    """Test whether the value of a key is empty or zero, as `rolling_shutter` of a global shutter: [0, 0, 0, 0]."""
    return all(map(_says_nothing, value)) if isinstance(value, list) else value in (None, False, 0, "")


def _numbers(level: Mapping[str, Any], rational: bool, where: str) -> dict[str, float]:
    """Read the numbers of one level under the names of nerfstudio; q1, q2 and q3 are coefficients of the denominator.

    Args:
        level: keys of a frame or of the file.
        rational: whether k4, k5 and k6 belong to the denominator (`FULL_OPENCV`).
        where: subject of the error message.
    """
    numbers = {key: level[key] for key in _NUMBERS if level.get(key) is not None}
    check(f"{where}: ", _NUMBERS, numbers)
    matrix, dist = level.get("cam_mat"), level.get("dist")
    for key, others in (("cam_mat", ("fl_x", "fl_y", "cx", "cy")), ("dist", _NAMES)):
        both = [other for other in others if level.get(key) is not None and other in numbers]
        if both:
            raise NerfroError(f"{where}: {key} and {both[0]} both state the lens; keep one of them")
    if matrix is not None:
        lens = Lens.of_matrix(parse_matrix(matrix, ((3, 3),), f"{where}: cam_mat"), f"{where}: cam_mat")
        numbers |= {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
        check(f"{where}: cam_mat: ", _NUMBERS, numbers)
    if rational:
        renamed = zip(("k4", "k5", "k6"), _COEFFICIENTS[2], strict=True)
        numbers |= {new: numbers.pop(old) for old, new in renamed if old in numbers}
    if numbers.pop("k5", 0) or numbers.pop("k6", 0):
        raise NerfroError(
            f"{where}: k5 and k6 belong to OpenCV's rational model, in which k4, k5 and k6 form the denominator; set "
            "camera_model to FULL_OPENCV, or remove both"
        )
    if dist is not None:
        numbers |= _opencv_distortion(dist, where)
    for axis in "xy":
        if f"{axis}_fov" in numbers:
            numbers.setdefault(f"camera_angle_{axis}", math.radians(numbers[f"{axis}_fov"]))
    return numbers


def _opencv_distortion(numbers: Any, where: str) -> dict[str, float]:
    """Read `dist`: 4, 5 or 8 distortion coefficients in OpenCV's order."""
    # cv2.calibrateCamera returns a matrix with one row.
    if isinstance(numbers, list) and len(numbers) == 1 and isinstance(numbers[0], list):
        (numbers,) = numbers
    if not isinstance(numbers, list) or len(numbers) not in (0, 4, 5, 8) or not all(map(is_number, numbers)):
        raise NerfroError(
            f"{where}: dist={numbers!r} must be 4, 5 or 8 numbers in OpenCV's order: k1, k2, p1, p2, k3, ..."
        )
    names = [name for group in _COEFFICIENTS for name in group]
    return dict(zip(names, opencv_coefficients(numbers) or [0.0] * len(names), strict=True))


def _focal_lengths(
    frame: Mapping[str, float], file: Mapping[str, float], size: tuple[float, float], where: str
) -> tuple[float, float]:
    """Return fx and fy in pixels from the keys of the frame if it has any, otherwise from those of the file."""
    for level in (frame, file):
        fx, fy = (_focal_length(level, axis, side, where) for axis, side in zip("xy", size, strict=True))
        # Pixels are square, unless a frame changes fl_x alone beside the fl_y of its file.
        if fx is not None:
            return fx, fy if fy is not None else file.get("fl_y", fx) if "fl_x" in level else fx
        if fy is not None:
            return file.get("fl_x", fy) if "fl_y" in level else fy, fy
    raise NerfroError(
        f"{where} has no focal length; add fl_x (pixels), camera_angle_x (horizontal field of view in radians) or "
        "cam_mat (3x3 camera matrix in pixels), to the frame or to the file"
    )


def _focal_length(level: Mapping[str, float], axis: str, side: float, where: str) -> float | None:
    """Return the focal length that one level states, in pixels, and warn of two that differ by more than rounding."""
    stated, angle = level.get(f"fl_{axis}"), level.get(f"camera_angle_{axis}")
    if angle is None:
        return stated
    of_angle = 0.5 * side / math.tan(0.5 * angle)
    if stated is not None and abs(of_angle - stated) > 0.02 * stated:
        _warn_of_contradiction(where.partition(":")[0], axis, stated, angle, side, of_angle)
    return of_angle if stated is None else stated


@functools.cache  # one line for all frames of a file
def _warn_of_contradiction(file: str, axis: str, stated: float, angle: float, side: float, of_angle: float) -> None:
    warn(
        f"{file}: fl_{axis}={stated:g} contradicts camera_angle_{axis}={angle:g}, with which {side:g} pixels have the "
        f"focal length {of_angle:g}; fl_{axis} is taken: remove the wrong one, or state the calibrated size by w and h"
    )


def lens_tensors(lenses: Sequence[Lens]) -> tuple[Float[Tensor, "V 4"], Float[Tensor, "V 9"] | None]:
    """Return fx, fy, cx and cy of lenses in double precision, and their distortion; None if no lens is distorted."""
    intrinsics = torch.tensor([(lens.fx, lens.fy, lens.cx, lens.cy) for lens in lenses], dtype=torch.float64)
    if all(lens.distortion is None for lens in lenses):
        return intrinsics, None
    return intrinsics, torch.tensor([lens.distortion or (0.0,) * 9 for lens in lenses])


def check_lenses(lenses: Iterable[Lens], names: Iterable[str], size: tuple[int, int]) -> None:
    """Refuse implausible lenses, and warn of a principal point outside the image.

    Args:
        lenses: one lens per image.
        names: subjects of the error messages.
        size: width and height of the images in pixels.

    Raises:
        NerfroError: a focal length, pixel ratio or principal point is beyond reason, or a distortion is not invertible.
    """
    longer, outside = max(size), []
    limits = {
        # A field of view from 0.06 to 177.7 degrees.
        "fx": Annotated[float, Ge(0.01 * longer), Le(1000 * longer)],
        "fy / fx": Annotated[float, Ge(1 / 4), Le(4)],
        **{key: Annotated[float, Ge(-5 * side), Le(6 * side)] for key, side in zip(("cx", "cy"), size, strict=True)},
    }
    first: dict[Lens, str] = {}
    for lens, name in zip(lenses, names, strict=True):
        first.setdefault(lens, name)
    for lens, name in first.items():
        where = f"{name}: the lens, for an image of {size[0]}x{size[1]} pixels, has "
        check(where, limits, {"fx": lens.fx})
        check(where, limits, {"fy / fx": lens.fy / lens.fx, "cx": lens.cx, "cy": lens.cy})
        if not (0 <= lens.cx <= size[0] and 0 <= lens.cy <= size[1]):
            outside.append(name)
        if lens.distortion is not None:
            _check_distortion(lens, size, name)
    if outside:
        warn(f"the principal point lies outside the image: {first_of(outside)}; check the size of the images")


def _check_distortion(lens: Lens, size: tuple[int, int], name: str) -> None:
    """Refuse a distortion that is not invertible within the image, as for polynomials fitted to the image centre."""
    fractions = torch.linspace(0, 1, 9, dtype=torch.float64)
    grid = torch.cartesian_prod(fractions, fractions)  # the interior as well, because the fold may lie there
    focal, centre = (torch.tensor(pair, dtype=torch.float64) for pair in ((lens.fx, lens.fy), (lens.cx, lens.cy)))
    points = (grid * torch.tensor(size) - centre) / focal
    distortion = torch.tensor(lens.distortion, dtype=torch.float64).expand(len(points), 9)
    ideal, area = undistort(points, distortion)
    error: Tensor = (distort(ideal, distortion)[0] - points).norm(dim=-1) * lens.fx
    # A point that is undistorted and distorted again moves by at most 0.01 pixels.
    if not bool(((error < 0.01) & (area > 0)).all()):
        raise NerfroError(
            f"{name}: the lens distortion is not invertible everywhere in the image; "
            "check the coefficients and their order, or undistort the images first"
        )
