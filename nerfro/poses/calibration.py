"""Estimation of lens and poses from the detected tags of a known board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.core.provenance import AlgorithmSettings
from nerfro.poses.boards import TagDetections
from nerfro.poses.opencv import opencv
from nerfro.poses.options import LensModel


@dataclass(frozen=True)
class TagSettings(AlgorithmSettings):
    """Settings of the calibration by tags.

    Attributes:
        outlier_deviations, min_outlier_error: a corner is an outlier (of a misread tag, or of a tag seen through the
            glass) if its error exceeds so many standard deviations and so many pixels.
        max_estimates: largest number of estimates.
        min_tags: images with fewer tags are skipped; the paper's authors require twelve corners, four for each tag.
        min_images: smallest number of images, because fewer do not determine the lens.
        initial_focal: initial focal length of the paper's authors, in units of the longer side of the image.
    """

    outlier_deviations: float = 5.0
    min_outlier_error: float = 1.0
    max_estimates: int = 10
    min_tags: int = 3
    min_images: int = 3
    initial_focal: float = 1.2


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
        num_observations: number of tags, or of 3-D points of COLMAP, that determine the pose.
        error: root mean square reprojection error, in pixels; NaN without observations.
    """

    camera_to_world: Float[np.ndarray, "3 4"]
    num_observations: int
    error: float


@dataclass(frozen=True)
class Calibration:
    """Estimated lens and poses.

    Attributes:
        intrinsics: the lens.
        poses: poses by image name.
        skipped: reason by name, for images without a pose.
        num_outliers: number of corners of tags that were removed as outliers; 0 for a model of COLMAP.
    """

    intrinsics: Intrinsics
    poses: dict[str, Pose]
    skipped: dict[str, str]
    num_outliers: int

    @property
    def errors(self) -> list[float]:
        """Root mean square reprojection errors of the images with observations, in pixels."""
        return [pose.error for pose in self.poses.values() if pose.num_observations]

    @property
    def mean_error(self) -> float:
        """Mean over the images of the root mean square reprojection error, in pixels; 0 without observations."""
        return float(np.mean(self.errors)) if self.errors else 0.0

    def lines(self, observations: str) -> list[str]:
        """Format a report: the error of each image, skipped images, and the lens.

        Args:
            observations: noun for the observations, in the plural.
        """
        lines = [f"reprojection error in pixels (rms) and number of {observations} by image:"]
        for name, pose in sorted(self.poses.items()):
            error = f"{pose.error:6.3f}" if pose.num_observations else f"{'-':>6}"
            lines.append(f"  {error}  {pose.num_observations:4d}  {name}")
        if self.errors:
            lines.append(f"  {self.mean_error:6.3f}  mean; {max(self.errors):.3f} largest")
        lines += [f"  skipped: {name}: {reason}" for name, reason in sorted(self.skipped.items())]
        if self.num_outliers:
            lines.append(f"{self.num_outliers} points removed as outliers: misread, or seen through the object")
        matrix, deviation = self.intrinsics.matrix, self.intrinsics.focal_deviation
        lens = f"fx={matrix[0, 0]:.2f} fy={matrix[1, 1]:.2f} cx={matrix[0, 2]:.2f} cy={matrix[1, 2]:.2f} "
        lens += f"distortion={[round(number, 5) for number in self.intrinsics.distortion]}"
        return [*lines, lens + ("" if deviation is None else f"; standard deviation of fx {deviation:.2f}")]


def calibrate_by_tags(
    detections: dict[str, TagDetections],
    size: tuple[int, int],
    model: LensModel,
    settings: TagSettings = TagSettings(),
) -> Calibration:
    """Minimize the reprojection error over all poses and the lens.

    Estimation and removal of outliers alternate until no outliers remain.

    Args:
        detections: detected tags by image name.
        size: width and height of the images, in pixels.
        model: distortion coefficients to estimate.
        settings: limits, and the initial focal length.

    Raises:
        NerfroError: too few images have enough tags, or the lens cannot be estimated.
    """
    settings.use()
    min_tags, min_images = settings.min_tags, settings.min_images
    skipped: dict[str, str] = {}
    num_outliers = dict.fromkeys(detections, 0)
    current = dict(detections)
    for number in range(1, settings.max_estimates + 1):
        kept = {name: tags for name, tags in current.items() if tags.num_tags >= min_tags}
        for name, tags in current.items():
            if name not in kept:
                removed = f" ({num_outliers[name]} points removed as outliers)" if num_outliers[name] else ""
                skipped[name] = f"{tags.num_tags} tags found, {min_tags} needed{removed}"
        if len(kept) < min_images:
            raise NerfroError(
                f"{len(kept)} of {len(detections)} images show at least {min_tags} tags of the board, {min_images} "
                "are needed; check board=, and that the board is sharp and large enough in the images"
            )
        intrinsics, extrinsics = _estimate(list(kept.values()), size, model, settings.initial_focal)
        located = dict(zip(kept, extrinsics, strict=True))
        errors = {name: _errors(tags, intrinsics, *located[name]) for name, tags in kept.items()}
        # The median of 2-D normal errors is 1.18 standard deviations.
        deviation = float(np.median(np.concatenate(list(errors.values())))) / 1.18
        limit = max(settings.min_outlier_error, settings.outlier_deviations * deviation)
        # A tag is an outlier if the error of a corner exceeds the limit and half the largest error of the image. One
        # misread tag disturbs the whole pose, so smaller errors are judged again after the largest are removed.
        outliers = {
            name: kept[name].of_same_tags(error > max(limit, 0.5 * error.max())) for name, error in errors.items()
        }
        if number == settings.max_estimates or not any(outlying.any() for outlying in outliers.values()):
            break
        for name, outlying in outliers.items():
            num_outliers[name] += int(outlying.sum())
        current = {name: kept[name].select(~outlying) for name, outlying in outliers.items()}
    poses = {}
    for name, (rotation, translation) in located.items():
        camera_axes = opencv().Rodrigues(rotation)[0].T
        error = float(np.sqrt((errors[name] ** 2).mean()))
        pose = np.column_stack([camera_axes, -camera_axes @ translation])
        poses[name] = Pose(pose, kept[name].num_tags, error)
    return Calibration(intrinsics, poses, skipped, sum(num_outliers.values()))


def _estimate(
    detections: list[TagDetections], size: tuple[int, int], model: LensModel, initial_focal: float
) -> tuple[Intrinsics, list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]]:
    """Estimate the lens, and for each image the rotation vector and translation from world to camera."""
    cv2 = opencv()
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    if model != "opencv":
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    if model == "pinhole":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    focal = initial_focal * max(size)
    guess = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    _, matrix, distortion, rotations, translations, deviations, _, _ = cv2.calibrateCameraExtended(
        [tags.board_points.astype(np.float32) for tags in detections],
        [tags.image_points.astype(np.float32) for tags in detections],
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
    detections: TagDetections,
    intrinsics: Intrinsics,
    rotation: Float[np.ndarray, "3"],
    translation: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " corners"]:
    """Compute the distances between corners and their projections, in pixels."""
    distortion = np.array(intrinsics.distortion) if intrinsics.distortion else None
    projected, _ = opencv().projectPoints(detections.board_points, rotation, translation, intrinsics.matrix, distortion)
    return np.linalg.norm(projected.reshape(-1, 2) - detections.image_points, axis=1)
