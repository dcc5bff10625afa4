"""Data format of COLMAP reconstructions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfro.allowed import Distance, Factor
from nerfro.data.base import Frame
from nerfro.data.bounds import usable_points
from nerfro.data.colmap_model import ColmapCamera, ColmapModel, read_colmap
from nerfro.data.frames import Every, FrameSet, PosedImages
from nerfro.data.image_files import Alpha, read_size
from nerfro.data.lenses import Lens
from nerfro.data.masks import find_mask
from nerfro.errors import NerfroError
from nerfro.lens import coefficients, opencv_coefficients
from nerfro.registry import register

_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "")


@register("data", "colmap")
class ColmapData(PosedImages):
    """Read a COLMAP reconstruction (text or binary) and its images, in the world of the reconstruction.

    All perspective camera models are supported, with distortion. Fisheye models are refused. Images may have been
    resized after the reconstruction.

    Args:
        root, near, far, downscale, alpha, mask_labels: see `PosedImages`. Without `near` and `far`, the bounds are 0.9
            and 1.1 times the distances of the nearest and the farthest 3-D point.
        images: folder of the images within the root.
        model: folder of the model within the root. By default, the first model in sparse/0, sparse, colmap/sparse/0 and
            the root is used.
        test_every: every n-th image by name, from the first, belongs to val and test.
    """

    def __init__(
        self,
        root: str,
        near: Distance | None = None,
        far: Distance | None = None,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
        mask_labels: list[int] | None = None,
        images: str = "images",
        model: str | None = None,
        test_every: Every = 8,
    ) -> None:
        super().__init__(root, near, far, downscale, alpha, mask_labels)
        self.images, self.model, self.test_every = images, model, test_every

    def read(self, split: str) -> FrameSet:
        folder = self._model_folder()
        model = read_colmap(folder)
        open_bounds = self.near is None or self.far is None
        nearest, farthest = _distance_range(model, folder) if open_bounds else (0.0, 0.0)
        images = self.held_out(model.images, self.test_every, split)
        frames = []
        for image in images:
            path = self.root / self.images / image.name
            if not path.is_file():
                raise NerfroError(f"image {path} of the model {folder} does not exist; set data.images, or restore it")
            frames.append(Frame(image.name, path, find_mask(self.root, path), image.camera_to_world))
        size = read_size(frames[0].image)[:2]
        lenses = []
        for image in images:
            camera, where = model.cameras[image.camera], f"{folder}: camera {image.camera}"
            lenses.append(lens_of(camera, where).resized((camera.width, camera.height), size, where))
        return FrameSet(frames, lenses, "opencv", 0.9 * nearest, 1.1 * farthest)

    def _model_folder(self) -> Path:
        folders = [self.root / name for name in ((self.model,) if self.model is not None else _MODEL_FOLDERS)]
        for folder in folders:
            if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
                return folder
        tried = ", ".join(map(str, folders))
        raise NerfroError(f"there is no COLMAP model (cameras.bin or .txt) in {tried}; set data.model to its folder")


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


def _distance_range(model: ColmapModel, folder: Path) -> tuple[float, float]:
    """Find the distances of the nearest and the farthest 3-D point in any view, without 0.1 % outliers at each end."""
    ranges, points = [], usable_points(model.points, folder)
    for image in model.images:
        distances = _distances_in_view(points, image.camera_to_world, model.cameras[image.camera])
        if len(distances) > 0:
            ranges.append(np.quantile(distances, [0.001, 0.999]))
    if not ranges:
        raise NerfroError(f"{folder} has no 3-D points in view to find bounds from; set data.near and data.far")
    near, far = np.array(ranges).T
    return float(near.min()), float(far.max())


def _distances_in_view(
    points: Float[np.ndarray, "P 3"], pose: Float[np.ndarray, "3 4"], camera: ColmapCamera
) -> Float[np.ndarray, "Q"]:
    """Distances of the points inside the view frustum; distortion is neglected."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    local = local[local[:, 2] > 0]
    slope = 0.5 * np.array([camera.width, camera.height]) / camera.params[0]
    inside = (np.abs(local[:, :2]) < slope * local[:, 2:]).all(-1)
    return np.linalg.norm(local[inside], axis=-1)
