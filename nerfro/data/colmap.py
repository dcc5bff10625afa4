"""A COLMAP reconstruction and its photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfro.allowed import Distance, Factor
from nerfro.data.base import Frame, Views
from nerfro.data.colmap_model import ColmapCamera, ColmapModel, read_colmap
from nerfro.data.frames import Every, Lens, PosedImages, held_out
from nerfro.data.image_files import Alpha
from nerfro.data.masks import find_mask
from nerfro.errors import NerfroError
from nerfro.lens import coefficients, opencv_coefficients
from nerfro.registry import register

_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "")


@register("data", "colmap")
class ColmapData(PosedImages):
    """Folder with images/ and a COLMAP model (sparse/0, text or binary), in the model's own world.

    Perspective cameras with any distortion that COLMAP has for them are read, fisheye lenses are refused. Images may
    have been resized after the reconstruction.

    Args:
        root, near, far, downscale, alpha: see `PosedImages`; bounds that are none take 0.9 and 1.1 of the distances of
            the nearest and the farthest 3-D points.
        images: folder of the images within the root.
        model: folder of the model within the root; none looks for sparse/0, sparse, colmap/sparse/0 and the root.
        test_every: every such image by name, from the first, is for val and test.
    """

    def __init__(
        self,
        root: str,
        near: Distance | None = None,
        far: Distance | None = None,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
        images: str = "images",
        model: str | None = None,
        test_every: Every = 8,
    ) -> None:
        super().__init__(root, near, far, downscale, alpha)
        self.images, self.model, self.test_every = images, model, test_every

    def load(self, split: str) -> Views:
        self.require(split)
        folder = self._model_folder()
        model = read_colmap(folder)
        open_bounds = self.near is None or self.far is None
        nearest, farthest = _distances(model, folder) if open_bounds else (0.0, 0.0)
        images = [model.images[i] for i in held_out(len(model.images), self.test_every, split, self.root)]
        frames = []
        for image in images:
            path = self.root / self.images / image.name
            if not path.is_file():
                raise NerfroError(f"image {path} of the model {folder} does not exist; set data.images, or restore it")
            frames.append(Frame(image.name, path, find_mask(self.root, path), image.camera_to_world))

        def lenses(width: int, height: int) -> list[Lens]:
            places = [(model.cameras[image.camera], f"{folder}: camera {image.camera}") for image in images]
            return [lens_of(c, at).resized((c.width, c.height), (width, height), at) for c, at in places]

        return self.views(frames, lenses, "opencv", 0.9 * nearest, 1.1 * farthest)

    def _model_folder(self) -> Path:
        folders = [self.root / name for name in ((self.model,) if self.model is not None else _MODEL_FOLDERS)]
        for folder in folders:
            if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
                return folder
        tried = ", ".join(map(str, folders))
        raise NerfroError(f"there is no COLMAP model (cameras.bin or .txt) in {tried}; set data.model to its folder")


def lens_of(camera: ColmapCamera, where: str) -> Lens:
    """The lens of a COLMAP camera of a supported model; COLMAP's pixel coordinates are nerfro's."""
    p = camera.params
    if camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        lens = Lens(p[0], p[0], p[1], p[2], coefficients(p[3:]))
    elif camera.model in ("PINHOLE", "OPENCV", "FULL_OPENCV"):
        lens = Lens(p[0], p[1], p[2], p[3], opencv_coefficients(p[4:]))
    else:
        raise NerfroError(
            f"{where} has the model {camera.model}, which is not supported; undistort the images with "
            "`colmap image_undistorter`, or reconstruct with PINHOLE, RADIAL, OPENCV or FULL_OPENCV"
        )
    if lens.fx <= 0 or lens.fy <= 0:
        raise NerfroError(f"{where} has the focal lengths {lens.fx:g}, {lens.fy:g}; they must be positive")
    return lens


def _distances(model: ColmapModel, folder: Path) -> tuple[float, float]:
    """Distances of the nearest and farthest 3-D points in any view, a thousandth at each end taken for outliers."""
    found = []
    for image in model.images:
        seen = _in_view(model.points, image.camera_to_world, model.cameras[image.camera])
        if len(seen) > 0:
            found.append(np.quantile(seen, [0.001, 0.999]))
    if not found:
        raise NerfroError(f"{folder} has no 3-D points in view to take bounds from; set data.near and data.far")
    near, far = np.array(found).T
    return float(near.min()), float(far.max())


def _in_view(
    points: Float[np.ndarray, "P 3"], pose: Float[np.ndarray, "3 4"], camera: ColmapCamera
) -> Float[np.ndarray, "Q"]:
    """Distances of the points within a camera's cone, without its distortion."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    local = local[local[:, 2] > 0]
    slope = 0.5 * np.array([camera.width, camera.height]) / camera.params[0]
    inside = (np.abs(local[:, :2]) < slope * local[:, 2:]).all(-1)
    return np.linalg.norm(local[inside], axis=-1)
