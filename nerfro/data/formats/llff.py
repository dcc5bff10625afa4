"""Data format of LLFF, with the world frames of LLFF and Eikonal Fields."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.data.base import Frame
from nerfro.data.frames import Every, FrameSet, PosedImages, check_pose, list_images, require_root
from nerfro.data.image_files import read_size
from nerfro.data.lenses import Lens
from nerfro.data.masks import find_mask
from nerfro.files.reading import load_array
from nerfro.registry.registration import register


@register("data", "llff")
class LlffData(PosedImages):
    """Read the LLFF format: images/ and poses_bounds.npy, which has one row of 17 numbers per image, sorted by name.

    Args:
        near: arc length at which rays begin, in units of the chosen frame. The default is 0.9 times the nearest depth
            in the file.
        far: arc length at which rays end. The default is the arc length to the farthest depth in the file (at most 2
            for `frame=eikonal`, as in Eikonal Fields) in the corner of the image with the widest field of view.
        options: see `PosedImages`.
        images: folder of the images within the root, such as images_8. The intrinsics are scaled to the image size.
        frame: world frame. `file` keeps the world of the file; `llff` scales by 1 / (0.75 nearest depth) and recentres;
            `eikonal` scales by 1 / (farthest - nearest depth), recentres and spherifies, as Eikonal Fields does.
        video: folder within the root with the images of val and test and a poses_bounds.npy in the same world. These
            poses are transformed like the training poses, and all images of the root are used for training.
        test_every: without a video, every n-th image, from the first, belongs to val and test.
    """

    def __init__(
        self,
        root: str,
        images: str = "images",
        frame: Literal["llff", "eikonal", "file"] = "llff",
        video: str | None = None,
        test_every: Every = 8,
        **options: Any,
    ) -> None:
        super().__init__(root, **options)
        self.images, self.frame, self.video, self.test_every = images, frame, video, test_every

    def read(self, split: str) -> FrameSet:
        poses, depths, sizes = read_poses_bounds(self.root / "poses_bounds.npy")
        transform = frame_transform(poses, depths, self.frame)
        # LLFF measures depths along the optical axis. The arc length to a depth is longest in the corner of the image.
        depths = depths * np.cbrt(np.linalg.det(transform[:3, :3]))
        height, width, focal = sizes.T
        # Eikonal Fields has a far bound of 2, in units of its rescaled world.
        farthest = min(float(depths.max()), 2.0 if self.frame == "eikonal" else math.inf)
        farthest *= float(np.sqrt(1 + 0.25 * (width**2 + height**2) / focal**2).max())
        folder = self.root
        if self.video is not None and split != "train":
            folder = self.root / self.video.replace("\\", "/")
            require_root(folder)
            poses, _, sizes = read_poses_bounds(folder / "poses_bounds.npy")
        files = list_images(folder / self.images)
        if len(files) != len(poses):
            raise NerfroError(
                f"{folder / self.images} holds {len(files)} images but {folder / 'poses_bounds.npy'} has {len(poses)} "
                "poses; images and poses are matched in the order of names, so restore the images that were calibrated"
            )
        poses, indices = map_poses(poses, transform), list(range(len(files)))
        if self.video is None:
            indices = self.held_out(indices, self.test_every, split)
        frames = [Frame(files[i].name, files[i], find_mask(folder, files[i]), poses[i]) for i in indices]
        size, where = read_size(frames[0].image)[:2], f"{folder / 'poses_bounds.npy'}"
        lenses = [Lens(f, f, 0.5 * w, 0.5 * h).resized((w, h), size, where) for h, w, f in sizes[indices].tolist()]
        return FrameSet(frames, lenses, "opengl", 0.9 * float(depths.min()), farthest)


def read_poses_bounds(
    path: Path,
) -> tuple[Float[np.ndarray, "V 3 4"], Float[np.ndarray, "V 2"], Float[np.ndarray, "V 3"]]:
    """Read a poses_bounds.npy file.

    Returns:
        For each image: camera-to-world matrix with OpenGL axes (the file stores down, right, back), nearest and
        farthest depth in world units, and height, width and focal length in pixels.
    """
    if not path.is_file():
        raise NerfroError(f"{path} does not exist; create it with LLFF's imgs2poses.py, or use data=colmap")
    rows = load_array(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0:
        raise NerfroError(f"{path} has shape {rows.shape}; it must be [images, 17]; create it again")
    if not np.isfinite(rows).all():
        raise NerfroError(
            f"{path} holds NaN or infinite numbers in row {int(np.isfinite(rows).all(1).argmin())}; correct it"
        )
    matrices, depths = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    down, right, back, centre, size = (matrices[:, :, i] for i in range(5))
    if depths.min() <= 0 or (depths[:, 0] >= depths[:, 1]).any() or size.min() <= 0:
        raise NerfroError(
            f"{path}: depths must be positive and ascend, and height, width and focal length must be positive"
        )
    poses = np.stack([right, -down, back, centre], -1)
    for i, pose in enumerate(poses):
        check_pose(pose, f"{path}: row {i}", "the pose")
    return poses, depths, size


def frame_transform(
    poses: Float[np.ndarray, "V 3 4"], depths: Float[np.ndarray, "V 2"], frame: str
) -> Float[np.ndarray, "4 4"]:
    """Compute the similarity transformation from the world of the file to the chosen frame of `LlffData`.

    Sources: `load_llff_data` of LLFF, and load_llff.py of Eikonal Fields.
    """
    if frame == "file":
        return np.eye(4)
    # LLFF scales the nearest depth to 1 / 0.75, which leaves a margin in front of the scene.
    scale = 1 / (0.75 * depths.min() if frame == "llff" else depths.max() - depths.min())
    transform = np.diag([scale, scale, scale, 1.0])
    transform = _recentre(map_poses(poses, transform)) @ transform
    if frame == "eikonal":
        transform = _spherify(map_poses(poses, transform)) @ transform
    return transform


def map_poses(poses: Float[np.ndarray, "V 3 4"], transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "V 3 4"]:
    """Apply a similarity transformation to camera-to-world matrices; the scale acts on the camera centres only."""
    mapped = transform[:3, :3] @ poses
    mapped[:, :, :3] /= np.cbrt(np.linalg.det(transform[:3, :3]))
    mapped[:, :, 3] += transform[:3, 3]
    return mapped


def _recentre(poses: Float[np.ndarray, "V 3 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the transformation to the frame of the average camera."""
    back = _unit(poses[:, :, 2].sum(0))
    right = _unit(np.cross(poses[:, :, 1].sum(0), back))
    up = np.cross(back, right)
    return _inverse(np.stack([right, up, back], -1), poses[:, :, 3].mean(0))


def _spherify(poses: Float[np.ndarray, "V 3 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the transformation that normalizes a ring of cameras.

    The origin is the point nearest to all optical axes, z points to the mean camera centre, and the root mean square
    distance of the cameras is 1.
    """
    axes, centres = poses[:, :, 2], poses[:, :, 3]
    orthogonal = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projections orthogonal to each axis
    matrix = orthogonal.mean(0)
    if np.linalg.cond(matrix) > 1e8:
        raise NerfroError(
            "data.frame=eikonal: all optical axes are parallel and have no nearest point; use data.frame=llff"
        )
    origin = np.linalg.solve(matrix, (orthogonal @ centres[:, :, None])[:, :, 0].mean(0))
    z = _unit((centres - origin).mean(0))
    x = _unit(np.cross([0.1, 0.2, 0.3], z))
    y = np.cross(z, x)
    transform = _inverse(np.stack([x, y, z], -1), origin)
    scale = 1 / np.sqrt(np.square(centres - origin).sum(-1).mean())
    return np.diag([scale, scale, scale, 1.0]) @ transform


def _inverse(rotation: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation.T, -rotation.T @ centre
    return transform


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / np.linalg.norm(vector)
