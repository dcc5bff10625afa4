"""Lens and poses from the points of a known target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from nerfro.capture.targets import Sighting, opencv
from nerfro.errors import NerfroError

LensModel = Literal["pinhole", "radial", "opencv"]

# A point is taken out as wrong (a tag that is misread, or seen through the glass) where it is this many times farther
# off than is usual, and by this many pixels at least. A median of 2-D normal errors is 1.18 of their deviation.
_OUTLIER, _LEAST_ERROR = 5.0, 1.0
_ROUNDS = 10
# The guess that the paper's authors start from, in units of the image's longer side.
_FIRST_FOCAL = 1.2


@dataclass(frozen=True)
class Intrinsics:
    """One lens for all images: focal lengths and principal point in pixels from the image's corner.

    Attributes:
        matrix: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
        distortion: OpenCV's k1, k2, p1, p2 and perhaps k3, k4, k5, k6; empty for an ideal lens.
        focal_deviation: standard deviation of fx by the residuals, pixels; None where the lens was given.
    """

    matrix: Float[np.ndarray, "3 3"]
    distortion: tuple[float, ...] = ()
    focal_deviation: float | None = None


@dataclass(frozen=True)
class Pose:
    """One image's pose.

    Attributes:
        camera_to_world: [R | centre], OpenCV's axes.
        num_features: that it rests on.
        error: root mean square distance between points and their projections, pixels.
    """

    camera_to_world: Float[np.ndarray, "3 4"]
    num_features: int
    error: float


@dataclass(frozen=True)
class Calibration:
    """Lens, and poses by the images' names; an image without a pose has none here, and a reason in `skipped`."""

    intrinsics: Intrinsics
    poses: dict[str, Pose]
    skipped: dict[str, str]
    num_outliers: int

    @property
    def mean_error(self) -> float:
        """Of reprojection, pixels."""
        return float(np.nanmean([pose.error for pose in self.poses.values()]))

    def lines(self, feature: str) -> list[str]:
        """What there is to tell: each image's error, what was left out, and the lens; `feature` is a plural."""
        told = [f"reprojection error in pixels (rms), and {feature}, by image:"]
        told += [f"  {pose.error:6.3f}  {pose.num_features:4d}  {name}" for name, pose in sorted(self.poses.items())]
        largest = np.nanmax([pose.error for pose in self.poses.values()])
        told.append(f"  {self.mean_error:6.3f}  mean; {largest:.3f} largest")
        told += [f"  skipped: {name}: {reason}" for name, reason in sorted(self.skipped.items())]
        if self.num_outliers:
            told.append(f"{self.num_outliers} points were taken out as wrong: misread, or seen through the object")
        matrix, deviation = self.intrinsics.matrix, self.intrinsics.focal_deviation
        lens = f"fx={matrix[0, 0]:.2f} fy={matrix[1, 1]:.2f} cx={matrix[0, 2]:.2f} cy={matrix[1, 2]:.2f} "
        lens += f"distortion={[round(number, 5) for number in self.intrinsics.distortion]}"
        return [*told, lens + ("" if deviation is None else f"; standard deviation of fx {deviation:.2f}")]


def calibrate(
    sightings: dict[str, Sighting],
    size: tuple[int, int],
    model: LensModel,
    given: Intrinsics | None,
    fewest: int,
    feature: str,
) -> Calibration:
    """Minimise the reprojection error over all poses and, unless it is given, the lens.

    Points that stay far from their projection are taken out, and all is estimated anew, until none are. Images of a
    size (width, height) with fewer than `fewest` features (`feature` in the plural) are skipped.
    """
    skipped: dict[str, str] = {}
    lost = dict.fromkeys(sightings, 0)
    current, needed = dict(sightings), 3 if given is None else 1
    for _ in range(_ROUNDS):
        kept = {name: sighting for name, sighting in current.items() if sighting.num_features >= fewest}
        for name, sighting in current.items():
            if name not in kept:
                found = f"{sighting.num_features} {feature} found, {fewest} are needed"
                skipped[name] = found + (f" ({lost[name]} points taken out as wrong)" if lost[name] else "")
        if len(kept) < needed:
            raise NerfroError(
                f"{len(kept)} of {len(sightings)} images show {fewest} or more {feature} of the target, {needed} are "
                "needed; is it this target (board=, family=, dictionary=), sharp, and large enough in the images?"
            )
        intrinsics, placed = _estimate(list(kept.values()), size, model, given)
        located = dict(zip(kept, placed, strict=True))
        errors = {name: _errors(sighting, intrinsics, *located[name]) for name, sighting in kept.items()}
        limit = max(_LEAST_ERROR, _OUTLIER * float(np.median(np.concatenate(list(errors.values())))) / 1.18)
        wrong = {name: _worst(kept[name], error, limit) for name, error in errors.items()}
        if not any(one.any() for one in wrong.values()):
            break
        for name, one in wrong.items():
            lost[name] += int(one.sum())
        current = {name: kept[name].only(~one) for name, one in wrong.items()}
    poses = {}
    for name, (rotation, shift) in located.items():
        turn = opencv().Rodrigues(rotation)[0].T
        error = float(np.sqrt((errors[name] ** 2).mean()))
        poses[name] = Pose(np.column_stack([turn, -turn @ shift]), kept[name].num_features, error)
    return Calibration(intrinsics, poses, skipped, sum(lost.values()))


def _worst(sighting: Sighting, errors: Float[np.ndarray, "N"], limit: float) -> Bool[np.ndarray, "N"]:
    """All points of the features that are off by more than the limit and at least half as much as the image's worst.

    One wrong tag turns the whole pose, so the less wrong ones get a second chance.
    """
    off = errors > max(limit, 0.5 * errors.max())
    return np.isin(sighting.features, sighting.features[off])


def _estimate(
    sightings: list[Sighting], size: tuple[int, int], model: LensModel, given: Intrinsics | None
) -> tuple[Intrinsics, list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]]:
    """The lens, and each image's rotation vector and shift from the world to the camera."""
    cv2 = opencv()
    if given is not None:
        return given, [_pose(sighting, given) for sighting in sightings]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    if model != "opencv":
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    if model == "pinhole":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    focal = _FIRST_FOCAL * max(size)
    guess = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    _, matrix, distortion, rotations, shifts, deviations, _, _ = cv2.calibrateCameraExtended(
        [sighting.points.astype(np.float32) for sighting in sightings],
        [sighting.pixels.astype(np.float32) for sighting in sightings],
        size,
        guess,
        np.zeros(5),
        flags=flags,
    )
    if not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise NerfroError(
            "the lens cannot be found from these images; photograph the target from more directions, "
            "or give intrinsics=[fx,fy,cx,cy]"
        )
    coefficients = () if model == "pinhole" else tuple(map(float, np.ravel(distortion)[:4]))
    poses = [(np.ravel(rotation), np.ravel(shift)) for rotation, shift in zip(rotations, shifts, strict=True)]
    return Intrinsics(np.asarray(matrix), coefficients, float(np.ravel(deviations)[0])), poses


def _pose(sighting: Sighting, given: Intrinsics) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    cv2 = opencv()
    lens = given.matrix, np.array(given.distortion) if given.distortion else None
    # SQPnP finds the global minimum of its cost, for flat targets as well; refinement is that of the pixels.
    _, rotation, shift = cv2.solvePnP(sighting.points, sighting.pixels, *lens, flags=cv2.SOLVEPNP_SQPNP)
    rotation, shift = cv2.solvePnPRefineLM(sighting.points, sighting.pixels, *lens, rotation, shift)
    return np.ravel(rotation), np.ravel(shift)


def _errors(
    sighting: Sighting, intrinsics: Intrinsics, rotation: Float[np.ndarray, "3"], shift: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "N"]:
    """Distances between points and their projections, pixels."""
    distortion = np.array(intrinsics.distortion) if intrinsics.distortion else None
    projected, _ = opencv().projectPoints(sighting.points, rotation, shift, intrinsics.matrix, distortion)
    return np.linalg.norm(projected.reshape(-1, 2) - sighting.pixels, axis=1)
