"""Estimation of lens and poses from the points of a known board."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from nerfro.errors import NerfroError

from .boards import Sighting
from .opencv import opencv

LensModel = Literal["pinhole", "radial", "opencv"]

# A point is an outlier (a misread tag, or a tag seen through the glass) if its error exceeds so many standard
# deviations and so many pixels. The median of 2-D normal errors is 1.18 standard deviations.
_OUTLIER_DEVIATIONS, _MIN_OUTLIER_ERROR = 5.0, 1.0
_ROUNDS = 10
# Images with fewer tags are skipped; the paper's authors require twelve corners, four for each tag. Fewer images do
# not determine the lens.
_MIN_TAGS, _MIN_IMAGES = 3, 3
# Initial focal length of the paper's authors, in units of the longer side of the image.
_INITIAL_FOCAL = 1.2


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of the one lens of all images, in pixels from the corner of the image.

    Attributes:
        matrix: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
        distortion: OpenCV's coefficients k1, k2, p1, p2 and optionally k3, k4, k5, k6; empty for an ideal lens.
        focal_deviation: standard deviation of fx estimated from the residuals, in pixels; None for a model of COLMAP.
    """

    matrix: Float[np.ndarray, "3 3"]
    distortion: tuple[float, ...] = ()
    focal_deviation: float | None = None


@dataclass(frozen=True)
class Pose:
    """Pose of one image.

    Attributes:
        camera_to_world: [R | centre] in OpenCV's camera axes.
        num_features: number of features that determine the pose.
        error: root mean square reprojection error, in pixels; NaN without features.
    """

    camera_to_world: Float[np.ndarray, "3 4"]
    num_features: int
    error: float


@dataclass(frozen=True)
class Calibration:
    """Estimated lens and poses."""

    intrinsics: Intrinsics
    poses: dict[str, Pose]  # by image name
    skipped: dict[str, str]  # reason by name, for images without a pose
    num_outliers: int

    @property
    def errors(self) -> list[float]:
        """Root mean square reprojection errors of the images with features, in pixels."""
        return [pose.error for pose in self.poses.values() if pose.num_features]

    @property
    def mean_error(self) -> float:
        """Mean over the images of the root mean square reprojection error, in pixels; 0 without features."""
        return float(np.mean(self.errors)) if self.errors else 0.0

    def lines(self, feature: str) -> list[str]:
        """Format a report: the error of each image, skipped images, and the lens; `feature` is a noun in the plural."""
        lines = [f"reprojection error in pixels (rms) and number of {feature} by image:"]
        for name, pose in sorted(self.poses.items()):
            error = f"{pose.error:6.3f}" if pose.num_features else f"{'-':>6}"
            lines.append(f"  {error}  {pose.num_features:4d}  {name}")
        if self.errors:
            lines.append(f"  {self.mean_error:6.3f}  mean; {max(self.errors):.3f} largest")
        lines += [f"  skipped: {name}: {reason}" for name, reason in sorted(self.skipped.items())]
        if self.num_outliers:
            lines.append(f"{self.num_outliers} points removed as outliers: misread, or seen through the object")
        matrix, deviation = self.intrinsics.matrix, self.intrinsics.focal_deviation
        lens = f"fx={matrix[0, 0]:.2f} fy={matrix[1, 1]:.2f} cx={matrix[0, 2]:.2f} cy={matrix[1, 2]:.2f} "
        lens += f"distortion={[round(number, 5) for number in self.intrinsics.distortion]}"
        return [*lines, lens + ("" if deviation is None else f"; standard deviation of fx {deviation:.2f}")]


def calibrate(sightings: dict[str, Sighting], size: tuple[int, int], model: LensModel) -> Calibration:
    """Minimize the reprojection error over all poses and the lens.

    Estimation and removal of outliers alternate until no outliers remain.

    Args:
        sightings: detected points by image name.
        size: width and height of the images, in pixels.
        model: distortion coefficients to estimate.

    Raises:
        NerfroError: too few images have enough tags, or the lens cannot be estimated.
    """
    skipped: dict[str, str] = {}
    num_outliers = dict.fromkeys(sightings, 0)
    current = dict(sightings)
    for _ in range(_ROUNDS):
        kept = {name: sighting for name, sighting in current.items() if sighting.num_features >= _MIN_TAGS}
        for name, sighting in current.items():
            if name not in kept:
                removed = f" ({num_outliers[name]} points removed as outliers)" if num_outliers[name] else ""
                skipped[name] = f"{sighting.num_features} tags found, {_MIN_TAGS} needed{removed}"
        if len(kept) < _MIN_IMAGES:
            raise NerfroError(
                f"{len(kept)} of {len(sightings)} images show at least {_MIN_TAGS} tags of the board, {_MIN_IMAGES} "
                "are needed; check board=, and that the board is sharp and large enough in the images"
            )
        intrinsics, extrinsics = _estimate(list(kept.values()), size, model)
        located = dict(zip(kept, extrinsics, strict=True))
        errors = {name: _errors(sighting, intrinsics, *located[name]) for name, sighting in kept.items()}
        deviation = float(np.median(np.concatenate(list(errors.values())))) / 1.18
        limit = max(_MIN_OUTLIER_ERROR, _OUTLIER_DEVIATIONS * deviation)
        outliers = {name: _outliers(kept[name], error, limit) for name, error in errors.items()}
        if not any(chosen.any() for chosen in outliers.values()):
            break
        for name, chosen in outliers.items():
            num_outliers[name] += int(chosen.sum())
        current = {name: kept[name].only(~chosen) for name, chosen in outliers.items()}
    poses = {}
    for name, (rotation, translation) in located.items():
        camera_axes = opencv().Rodrigues(rotation)[0].T
        error = float(np.sqrt((errors[name] ** 2).mean()))
        pose = np.column_stack([camera_axes, -camera_axes @ translation])
        poses[name] = Pose(pose, kept[name].num_features, error)
    return Calibration(intrinsics, poses, skipped, sum(num_outliers.values()))


def _outliers(
    sighting: Sighting, errors: Float[np.ndarray, " features"], limit: float
) -> Bool[np.ndarray, " features"]:
    """Select all points of the features whose error exceeds both the limit and half the largest error of the image.

    One misread tag disturbs the whole pose, so smaller errors are judged again after the largest ones are removed.
    """
    exceeds = errors > max(limit, 0.5 * errors.max())
    return np.isin(sighting.features, sighting.features[exceeds])


def _estimate(
    sightings: list[Sighting], size: tuple[int, int], model: LensModel
) -> tuple[Intrinsics, list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]]:
    """Estimate the lens, and for each image the rotation vector and translation from world to camera."""
    cv2 = opencv()
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    if model != "opencv":
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    if model == "pinhole":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    focal = _INITIAL_FOCAL * max(size)
    guess = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    _, matrix, distortion, rotations, translations, deviations, _, _ = cv2.calibrateCameraExtended(
        [sighting.points.astype(np.float32) for sighting in sightings],
        [sighting.pixels.astype(np.float32) for sighting in sightings],
        size,
        guess,
        np.zeros(5),
        flags=flags,
    )
    if not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise NerfroError("the lens cannot be estimated from these images; photograph the board from more directions")
    coefficients = () if model == "pinhole" else tuple(map(float, np.ravel(distortion)[:4]))
    extrinsics = [(np.ravel(r), np.ravel(t)) for r, t in zip(rotations, translations, strict=True)]
    return Intrinsics(np.asarray(matrix), coefficients, float(np.ravel(deviations)[0])), extrinsics


def _errors(
    sighting: Sighting, intrinsics: Intrinsics, rotation: Float[np.ndarray, "3"], translation: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " features"]:
    """Compute the distances between points and their projections, in pixels."""
    distortion = np.array(intrinsics.distortion) if intrinsics.distortion else None
    projected, _ = opencv().projectPoints(sighting.points, rotation, translation, intrinsics.matrix, distortion)
    return np.linalg.norm(projected.reshape(-1, 2) - sighting.pixels, axis=1)
