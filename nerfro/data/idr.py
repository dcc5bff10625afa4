"""Data in the format of IDR and NeuS: one matrix for each camera, world to pixel."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import scipy.linalg
from jaxtyping import Float

from nerfro.allowed import Distance, Factor
from nerfro.data.base import Frame, Views
from nerfro.data.frames import Every, Lens, PosedImages, held_out, list_images
from nerfro.data.image_files import IMAGE_SUFFIXES, Alpha
from nerfro.data.transforms import parse_matrix
from nerfro.errors import NerfroError
from nerfro.files.cache import load_arrays
from nerfro.registry import register

_MAX_SKEW = 1e-3


@register("data", "idr")
class IdrData(PosedImages):
    """Folder with image/, mask/ and cameras_sphere.npz, as IDR, NeuS, NeTO and NEMTO have it.

    `world_mat_i` maps the world to pixels, `scale_mat_i` the unit sphere to the world. Masks belong to images in the
    order of names. Pixel centres are whole numbers there (NeuS, gen_rays_at), so half a pixel is added.

    Args:
        root, near, far, downscale, alpha: see `PosedImages`; bounds that are none take where rays enter the unit sphere
            at the earliest and leave it at the latest.
        cameras: name of the file of matrices.
        world: `sphere` is the frame in which the object lies in the unit sphere, `file` that of `world_mat` (of which
            `near` and `far` cannot be known).
        test_every: every such image by name, from the first, is for val and test.
    """

    def __init__(
        self,
        root: str,
        near: Distance | None = None,
        far: Distance | None = None,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
        cameras: str = "cameras_sphere.npz",
        world: Literal["sphere", "file"] = "sphere",
        test_every: Every = 8,
    ) -> None:
        super().__init__(root, near, far, downscale, alpha)
        if world == "file" and (near is None or far is None):
            raise NerfroError("data.world=file needs data.near and data.far, in units of that world")
        self.cameras, self.world, self.test_every = cameras, world, test_every

    def load(self, split: str) -> Views:
        self.require(split)
        images = list_images(_first_folder(self.root, ("image", "images", "rgb")))
        masks = _masks(self.root, len(images))
        file = self.root / self.cameras
        if not file.is_file():
            raise NerfroError(f"{file} does not exist; name the file of matrices with data.cameras")
        arrays = load_arrays(file)
        num_matrices = sum(name.startswith("world_mat_") and name[10:].isdigit() for name in arrays)
        if num_matrices != len(images):
            raise NerfroError(
                f"{file} has {num_matrices} matrices world_mat_<i> for {len(images)} images; make them equal"
            )
        projections = (self._projection(arrays, i, file) for i in range(len(images)))
        cameras = [decompose(projection, f"{file}: world_mat_{i}") for i, projection in enumerate(projections)]
        poses, lenses = zip(*cameras, strict=True)
        chosen = held_out(len(images), self.test_every, split, self.root)
        frames = [Frame(images[i].name, images[i], masks[i], poses[i]) for i in chosen]
        # Over all views, so that the splits agree.
        distance = np.linalg.norm(np.stack(poses)[:, :, 3], axis=-1)
        nearest, farthest = max(float(distance.min()) - 1, 0.0), float(distance.max()) + 1
        return self.views(frames, lambda width, height: [lenses[i] for i in chosen], "opencv", nearest, farthest)

    def _projection(self, arrays: dict[str, np.ndarray], index: int, file: Path) -> Float[np.ndarray, "3 4"]:
        product = np.eye(4)
        for name in [f"world_mat_{index}", f"scale_mat_{index}"][: 2 if self.world == "sphere" else 1]:
            if name not in arrays:
                raise NerfroError(f"{file} has no '{name}'; every image needs one")
            product = product @ parse_matrix(arrays[name], ((4, 4),), f"{file}: {name}")
        return product[:3]


def decompose(projection: Float[np.ndarray, "3 4"], where: str) -> tuple[Float[np.ndarray, "3 4"], Lens]:
    """Camera-to-world matrix (OpenCV axes) and lens of a projection matrix that takes whole numbers as pixel centres.

    By RQ factorisation; any factor of the matrix, and with it a uniform scale of the world, is immaterial. The matrix
    must be regular and without skew.
    """
    square = projection[:, :3]
    determinant = np.linalg.det(square)
    if abs(determinant) <= 1e-12 * max(np.abs(square).max(), 1e-30) ** 3:
        raise NerfroError(f"{where} is singular, so it is no camera; export the matrices again")
    # A matrix of either sign projects to the same pixels; this one has what is in front at positive depth.
    upper, rotation = scipy.linalg.rq(square * np.sign(determinant))
    signs = np.diag(np.sign(np.diag(upper)))
    intrinsics, rotation = upper @ signs, signs @ rotation
    intrinsics /= intrinsics[2, 2]
    fx, fy = float(intrinsics[0, 0]), float(intrinsics[1, 1])
    if abs(intrinsics[0, 1]) > _MAX_SKEW * fx:
        raise NerfroError(f"{where} has the skew {intrinsics[0, 1]:.3g}, which is not supported; calibrate without")
    centre = -np.linalg.solve(square, projection[:, 3])
    lens = Lens(fx, fy, float(intrinsics[0, 2]) + 0.5, float(intrinsics[1, 2]) + 0.5)
    return np.column_stack([rotation.T, centre]), lens


def _first_folder(root: Path, names: tuple[str, ...]) -> Path:
    return next((root / name for name in names if (root / name).is_dir()), root / names[0])


def _masks(root: Path, num_images: int) -> list[Path] | list[None]:
    """The masks in the order of names; they need not be called as the images are."""
    folder = _first_folder(root, ("mask", "masks"))
    if not folder.is_dir():
        return [None] * num_images
    masks = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if len(masks) != num_images:
        raise NerfroError(f"{folder} holds {len(masks)} masks for {num_images} images; give all of them one, or none")
    return masks
