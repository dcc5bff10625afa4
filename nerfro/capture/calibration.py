"""Estimation of lens and poses from the points of a known target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from nerfro.capture.targets import Sighting, opencv
from nerfro.errors import NerfroError

LensModel = Literal["pinhole", "radial", "opencv"]

# A point is an outlier (a misread tag, or a tag seen through the glass) if its error exceeds so many standard
# deviations and so many pixels. The median of 2-D normal errors is 1.18 standard deviations.
_OUTLIER_DEVIATIONS, _MIN_OUTLIER_ERROR = 5.0, 1.0
_ROUNDS = 10
# Initial focal length of the paper's authors, in units of the longer side of the image.
_INITIAL_FOCAL = 1.2


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of the one lens of all images, in pixels from the corner of the image.

    Attributes:
        matrix: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
        distortion: OpenCV's coefficients k1, k2, p1, p2 and optionally k3, k4, k5, k6; empty for an ideal lens.
        focal_deviation: standard deviation of fx estimated from the residuals, in pixels; None for a known lens.
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
        error: root mean square reprojection error, in pixels.
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
    def mean_error(self) -> float:
        """Mean over the images of the root mean square reprojection error, in pixels."""
        return float(np.nanmean([pose.error for pose in self.poses.values()]))

    def lines(self, feature: str) -> list[str]:
        """Format a report: the error of each image, skipped images, and the lens; `feature` is a noun in the plural."""
        lines = [f"reprojection error in pixels (rms) and number of {feature} by image:"]
        lines += [f"  {pose.error:6.3f}  {pose.num_features:4d}  {name}" for name, pose in sorted(self.poses.items())]
        largest = np.nanmax([pose.error for pose in self.poses.values()])
        lines.append(f"  {self.mean_error:6.3f}  mean; {largest:.3f} largest")
        lines += [f"  skipped: {name}: {reason}" for name, reason in sorted(self.skipped.items())]
        if self.num_outliers:
            lines.append(f"{self.num_outliers} points removed as outliers: misread, or seen through the object")
        matrix, deviation = self.intrinsics.matrix, self.intrinsics.focal_deviation
        lens = f"fx={matrix[0, 0]:.2f} fy={matrix[1, 1]:.2f} cx={matrix[0, 2]:.2f} cy={matrix[1, 2]:.2f} "
        lens += f"distortion={[round(number, 5) for number in self.intrinsics.distortion]}"
        return [*lines, lens + ("" if deviation is None else f"; standard deviation of fx {deviation:.2f}")]


def calibrate(
    sightings: dict[str, Sighting],
    size: tuple[int, int],
    model: LensModel,
    known: Intrinsics | None,
    min_features: int,
    feature: str,
) -> Calibration:
    """Minimize the reprojection error over all poses and, unless the lens is known, over the lens.

    Estimation and removal of outliers alternate until no outliers remain.

    Args:
        sightings: detected points by image name.
        size: width and height of the images, in pixels.
        model: distortion coefficients to estimate.
        known: known lens; None estimates the lens.
        min_features: images with fewer features are skipped.
        feature: noun in the plural for messages.

    Raises:
        NerfroError: too few images have enough features, or the lens cannot be estimated.
    """
    skipped: dict[str, str] = {}
    num_outliers = dict.fromkeys(sightings, 0)
    current, min_images = dict(sightings), 3 if known is None else 1
    for _ in range(_ROUNDS):
        kept = {name: sighting for name, sighting in current.items() if sighting.num_features >= min_features}
        for name, sighting in current.items():
            if name not in kept:
                removed = f" ({num_outliers[name]} points removed as outliers)" if num_outliers[name] else ""
                skipped[name] = f"{sighting.num_features} {feature} found, {min_features} needed{removed}"
        if len(kept) < min_images:
            raise NerfroError(
                f"{len(kept)} of {len(sightings)} images show at least {min_features} {feature} of the target, "
                f"{min_images} are needed; check board=, family= and dictionary=, and that the target is sharp and "
                "large enough in the images"
            )
        intrinsics, extrinsics = _estimate(list(kept.values()), size, model, known)
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


def _outliers(sighting: Sighting, errors: Float[np.ndarray, "N"], limit: float) -> Bool[np.ndarray, "N"]:
    """Select all points of the features whose error exceeds both the limit and half the largest error of the image.

    One misread tag disturbs the whole pose, so smaller errors are judged again after the largest ones are removed.
    """
    exceeds = errors > max(limit, 0.5 * errors.max())
    return np.isin(sighting.features, sighting.features[exceeds])


def _estimate(
    sightings: list[Sighting], size: tuple[int, int], model: LensModel, known: Intrinsics | None
) -> tuple[Intrinsics, list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]]:
    """Estimate the lens, and for each image the rotation vector and translation from world to camera."""
    cv2 = opencv()
    if known is not None:
        return known, [_pose(sighting, known) for sighting in sightings]
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
        raise NerfroError(
            "the lens cannot be estimated from these images; photograph the target from more directions, "
            "or give intrinsics=[fx,fy,cx,cy]"
        )
    coefficients = () if model == "pinhole" else tuple(map(float, np.ravel(distortion)[:4]))
    extrinsics = [(np.ravel(r), np.ravel(t)) for r, t in zip(rotations, translations, strict=True)]
    return Intrinsics(np.asarray(matrix), coefficients, float(np.ravel(deviations)[0])), extrinsics


def _pose(sighting: Sighting, known: Intrinsics) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    cv2 = opencv()
    lens = known.matrix, np.array(known.distortion) if known.distortion else None
    # SQPnP finds the global minimum of an algebraic cost, for flat targets as well; the refinement minimizes pixels.
    _, rotation, translation = cv2.solvePnP(sighting.points, sighting.pixels, *lens, flags=cv2.SOLVEPNP_SQPNP)
    rotation, translation = cv2.solvePnPRefineLM(sighting.points, sighting.pixels, *lens, rotation, translation)
    return np.ravel(rotation), np.ravel(translation)


def _errors(
    sighting: Sighting, intrinsics: Intrinsics, rotation: Float[np.ndarray, "3"], translation: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "N"]:
    """Compute the distances between points and their projections, in pixels."""
    distortion = np.array(intrinsics.distortion) if intrinsics.distortion else None
    projected, _ = opencv().projectPoints(sighting.points, rotation, translation, intrinsics.matrix, distortion)
    return np.linalg.norm(projected.reshape(-1, 2) - sighting.pixels, axis=1)
