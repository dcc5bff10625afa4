"""Data format of IDR and NeuS: one projection matrix per camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.data.base import Frame
from nerfro.data.frames import Every, FrameSet, PosedImages, list_images
from nerfro.data.image_files import IMAGE_SUFFIXES
from nerfro.data.lenses import Lens
from nerfro.data.masks import find_mask
from nerfro.files.reading import load_arrays, parse_matrix
from nerfro.registry.registration import register


@register("data", "idr")
class IdrData(PosedImages):
    """Read the format of IDR, NeuS, NeTO and NEMTO: image/, mask/ and cameras_sphere.npz.

    `world_mat_i` projects world points to pixels, and `scale_mat_i` maps the unit sphere to the world. Images and masks
    are matched in the order of names. In this format, pixel centres are at whole numbers (NeuS, `gen_rays_at`), so the
    principal point is shifted by half a pixel.

    Args:
        near, far: bounds of the rays, arc lengths; by default, these enclose the unit sphere in all views.
        options: see `PosedImages`.
        cameras: name of the file with the matrices.
        world: `sphere` for the frame in which the object lies inside the unit sphere, or `file` for the world of
            `world_mat`, which requires `near` and `far`.
        test_every: every n-th image by name, from the first, belongs to val and test.
    """

    def __init__(
        self,
        root: str,
        cameras: str = "cameras_sphere.npz",
        world: Literal["sphere", "file"] = "sphere",
        test_every: Every = 8,
        **options: Any,
    ) -> None:
        super().__init__(root, **options)
        if world == "file" and (self.near is None or self.far is None):
            raise NerfroError("data.world=file needs data.near and data.far; set both, in units of this world")
        self.cameras, self.world, self.test_every = cameras, world, test_every

    def read(self, split: str) -> FrameSet:
        images = list_images(_first_folder(self.root, ("image", "images", "rgb")))
        masks = _list_masks(self.root, images)
        file = self.root / self.cameras
        if not file.is_file():
            raise NerfroError(f"{file} does not exist; set data.cameras to the file with the matrices")
        arrays = load_arrays(file)
        num_matrices = sum(name.startswith("world_mat_") and name[10:].isdigit() for name in arrays)
        if num_matrices != len(images):
            raise NerfroError(
                f"{file} has {num_matrices} matrices world_mat_<i> for {len(images)} images; the numbers must be equal"
            )
        numbers = range(len(images))
        cameras = (decompose(self._projection(arrays, i, file), f"{file}: world_mat_{i}") for i in numbers)
        poses, lenses = zip(*cameras, strict=True)
        indices = self.held_out(numbers, self.test_every, split)
        frames = [Frame(images[i].name, images[i], masks[i], poses[i]) for i in indices]
        # All views are considered, so that all splits have the same bounds.
        distance = np.linalg.norm(np.stack(poses)[:, :, 3], axis=-1)
        near, far = max(float(distance.min()) - 1, 0.0), float(distance.max()) + 1
        return FrameSet(frames, [lenses[i] for i in indices], "opencv", near, far)

    def _projection(self, arrays: dict[str, np.ndarray], index: int, file: Path) -> Float[np.ndarray, "3 4"]:
        product = np.eye(4)
        for name in [f"world_mat_{index}", f"scale_mat_{index}"][: 2 if self.world == "sphere" else 1]:
            if name not in arrays:
                raise NerfroError(f"{file} has no '{name}'; every image needs one")
            product = product @ parse_matrix(arrays[name], ((4, 4),), f"{file}: {name}")
        return product[:3]


def decompose(projection: Float[np.ndarray, "3 4"], where: str) -> tuple[Float[np.ndarray, "3 4"], Lens]:
    """Decompose a projection matrix into camera-to-world matrix and lens by RQ factorization.

    The scale of the matrix has no effect. Pixel centres of the matrix are at whole numbers.

    Returns:
        Camera-to-world matrix with OpenCV axes, and the lens.

    Raises:
        NerfroError: the matrix is singular or has skew.
    """
    square = projection[:, :3]
    determinant = np.linalg.det(square)
    if abs(determinant) <= 1e-12 * max(np.abs(square).max(), 1e-30) ** 3:
        raise NerfroError(f"{where} is singular and therefore not a camera; export the matrices again")
    # The matrix and its negative project equally. A positive determinant gives points in front a positive depth.
    upper, rotation = scipy.linalg.rq(square * np.sign(determinant))
    signs = np.diag(np.sign(np.diag(upper)))
    intrinsics, rotation = upper @ signs, signs @ rotation
    intrinsics /= intrinsics[2, 2]
    lens = Lens.of_matrix(intrinsics, f"the camera matrix of {where}", 1e-3)
    centre = -np.linalg.solve(square, projection[:, 3])
    return np.column_stack([rotation.T, centre]), replace(lens, cx=lens.cx + 0.5, cy=lens.cy + 0.5)


def _first_folder(root: Path, names: tuple[str, ...]) -> Path:
    return next((root / name for name in names if (root / name).is_dir()), root / names[0])


def _list_masks(root: Path, images: Sequence[Path]) -> Sequence[Path | None]:
    """List the masks by name; the names may differ from those of the images. Without a folder, search each mask."""
    folder = _first_folder(root, ("mask", "masks"))
    if not folder.is_dir():
        return [find_mask(root, image) for image in images]
    files = (path for path in folder.iterdir() if not path.name.startswith("."))
    masks = sorted(path for path in files if path.suffix.lower() in IMAGE_SUFFIXES)
    if len(masks) != len(images):
        raise NerfroError(f"{folder} holds {len(masks)} masks for {len(images)} images; give one per image, or none")
    return masks
