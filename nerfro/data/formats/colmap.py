"""Data format of COLMAP reconstructions."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.data.base import Frame
from nerfro.data.formats.colmap_model import (
    MODEL_FOLDERS,
    ColmapImage,
    ColmapModel,
    find_model_folder,
    lens_of,
    read_colmap,
)
from nerfro.data.frames import Every, FrameSet, PosedImages, find_bounds, image_edges, usable_points
from nerfro.data.image_files import read_size
from nerfro.data.masks import find_mask
from nerfro.files.reading import as_spelled
from nerfro.registry.registration import register


@register("data", "colmap")
class ColmapData(PosedImages):
    """Read a COLMAP reconstruction (text or binary) and its images, in the world of the reconstruction.

    All perspective camera models are supported, with distortion. Fisheye models are refused. Images may have been
    resized after the reconstruction.

    Args:
        near, far: bounds of the rays, arc lengths in world units; by default estimated from the 3-D points or from the
            cameras, see `find_bounds`.
        options: see `PosedImages`.
        images: folder of the images within the root.
        model: folder of the model within the root. By default, the model with the most images in the first of the
            folders sparse, colmap/sparse and the root that has one, itself or in numbered folders, as sparse/0.
        depths: whether the 3-D points that an image has observed give the depths of their pixels, see the loss `depth`.
        test_every: every n-th image by name, from the first, belongs to val and test.
    """

    def __init__(
        self,
        root: str,
        images: str = "images",
        model: str | None = None,
        depths: bool = False,
        test_every: Every = 8,
        **options: Any,
    ) -> None:
        super().__init__(root, **options)
        self.images, self.model, self.depths, self.test_every = images, model, depths, test_every

    def read(self, split: str) -> FrameSet:
        folder = self._model_folder
        model = read_colmap(folder)
        near, far = self.near, self.far
        if near is None or far is None:
            poses = np.stack([image.camera_to_world for image in model.images]) * [1.0, -1.0, -1.0, 1.0]
            edges = np.array([self._edges(model, image, folder) for image in model.images])
            near, far = find_bounds(poses, edges, usable_points(model.points, folder))
        images = self.held_out(model.images, self.test_every, split)
        frames = []
        for image in images:
            path = as_spelled(self.root / self.images, image.name)
            if not path.is_file():
                raise NerfroError(f"image {path} of the model {folder} does not exist; set data.images, or restore it")
            frames.append(Frame(image.name, path, find_mask(self.root, path), image.camera_to_world))
        size = read_size(frames[0].image)[:2]
        lenses = []
        for image in images:
            camera, where = model.cameras[image.camera], f"{folder}: camera {image.camera}"
            lenses.append(lens_of(camera, where).resized((camera.width, camera.height), size, where))
        points = [model.seen_by(image) for image in images] if self.depths else []
        return FrameSet(frames, lenses, "opencv", near, far, points=points)

    def _edges(self, model: ColmapModel, image: ColmapImage, folder: Path) -> Float[np.ndarray, "2 2"]:
        camera = model.cameras[image.camera]
        return image_edges(lens_of(camera, f"{folder}: camera {image.camera}"), camera.width, camera.height)

    @functools.cached_property
    def _model_folder(self) -> Path:
        folders = [self.root / name for name in ((self.model,) if self.model is not None else MODEL_FOLDERS)]
        folder = find_model_folder(folders)
        if folder is None:
            tried = ", ".join(map(str, folders))
            raise NerfroError(
                f"there is no COLMAP model (cameras.bin or .txt) in {tried}; set data.model to its folder"
            )
        return folder
