"""Data in the LLFF format, and what Eikonal Fields makes of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from nerfro.allowed import Distance, Factor
from nerfro.data.base import Frame, Views
from nerfro.data.frames import Every, Lens, PosedImages, check_pose, held_out, list_images, require_root
from nerfro.data.image_files import Alpha
from nerfro.data.masks import find_mask
from nerfro.errors import NerfroError
from nerfro.files.cache import load_array
from nerfro.registry import register

# LLFF leaves a quarter of the nearest depth free in front of what it sees.
_LLFF_BOUND_FACTOR = 0.75

# Eikonal Fields looks no farther than this after its rescaling.
_EIKONAL_FAR = 2.0


@register("data", "llff")
class LlffData(PosedImages):
    """Folder with images/ and poses_bounds.npy: images by name, one row of 17 numbers for each.

    Args:
        root, downscale, alpha: see `PosedImages`.
        near: arc length at which rays begin, in units of the chosen frame; none takes 0.9 of the file's least depth.
        far: arc length at which rays end; none takes the file's greatest depth (at most 2 for `frame=eikonal`, as its
            authors do), measured in the image's corner.
        images: folder of the images within the root, such as images_8; intrinsics follow its images' size.
        frame: the world: `file` leaves it as it is, `llff` scales by 1 / (0.75 least depth) and recentres,
            `eikonal` scales by 1 / (greatest - least depth), recentres and spherifies, as Eikonal Fields does.
        video: folder within the root, with its own poses_bounds.npy in the same world, whose images are val and test;
            they are mapped with the transformation of the training images, all of which are then trained on.
        test_every: every such image, from the first, is for val and test, where there is no video.
    """

    def __init__(
        self,
        root: str,
        near: Distance | None = None,
        far: Distance | None = None,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
        images: str = "images",
        frame: Literal["llff", "eikonal", "file"] = "llff",
        video: str | None = None,
        test_every: Every = 8,
    ) -> None:
        super().__init__(root, near, far, downscale, alpha)
        self.images, self.frame, self.video, self.test_every = images, frame, video, test_every

    def load(self, split: str) -> Views:
        self.require(split)
        poses, depths, sizes = read_poses_bounds(self.root / "poses_bounds.npy")
        transform = frame_transform(poses, depths, self.frame)
        # LLFF measures depths along the optical axis; the arc to the farthest one ends in the image's corner.
        depths = depths * np.cbrt(np.linalg.det(transform[:3, :3]))
        height, width, focal = sizes[0]
        farthest = min(float(depths.max()), _EIKONAL_FAR if self.frame == "eikonal" else math.inf)
        farthest *= math.hypot(1, 0.5 * width / focal, 0.5 * height / focal)
        folder = self.root
        if self.video is not None and split != "train":
            folder = self.root / self.video.replace("\\", "/")
            require_root(folder)
            poses, _, sizes = read_poses_bounds(folder / "poses_bounds.npy")
        files = list_images(folder / self.images)
        if len(files) != len(poses):
            raise NerfroError(
                f"{folder / self.images} holds {len(files)} images but {folder / 'poses_bounds.npy'} has {len(poses)} "
                "poses; they belong together by the order of names, so restore the images that were calibrated"
            )
        mapped, chosen = map_poses(poses, transform), list(range(len(files)))
        if self.video is None:
            chosen = held_out(len(files), self.test_every, split, self.root)
        frames = [Frame(files[i].name, files[i], find_mask(folder, files[i]), mapped[i]) for i in chosen]

        def lenses(width: int, height: int) -> list[Lens]:
            where = f"{folder / 'poses_bounds.npy'}"
            return [Lens(f, f, 0.5 * w, 0.5 * h).resized((w, h), (width, height), where) for h, w, f in sizes[chosen]]

        return self.views(frames, lenses, "opengl", 0.9 * float(depths.min()), farthest)


def read_poses_bounds(
    path: Path,
) -> tuple[Float[np.ndarray, "V 3 4"], Float[np.ndarray, "V 2"], Float[np.ndarray, "V 3"]]:
    """Read a poses_bounds.npy.

    Returns:
        Camera-to-world matrices with OpenGL axes (the file has down, right, back), least and greatest depth, and
        height, width and focal length in pixels, of each image.
    """
    if not path.is_file():
        raise NerfroError(f"{path} does not exist; make it with LLFF's imgs2poses.py, or use data=colmap directly")
    rows = load_array(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0:
        raise NerfroError(f"{path} has shape {rows.shape}; it must be [images, 17]")
    if not np.isfinite(rows).all():
        raise NerfroError(f"{path} holds NaN or infinite numbers in row {int(np.isfinite(rows).all(1).argmin())}")
    matrices, depths = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    down, right, back, centre, size = (matrices[:, :, i] for i in range(5))
    if depths.min() <= 0 or (depths[:, 0] >= depths[:, 1]).any() or size.min() <= 0:
        raise NerfroError(f"{path}: depths must ascend from above 0, and height, width and focal length be positive")
    poses = np.stack([right, -down, back, centre], -1)
    for i, pose in enumerate(poses):
        check_pose(pose, f"{path}: row {i}", "the pose")
    return poses, depths, size


def frame_transform(
    poses: Float[np.ndarray, "V 3 4"], depths: Float[np.ndarray, "V 2"], frame: str
) -> Float[np.ndarray, "4 4"]:
    """The similarity from the file's world to the chosen frame, see `LlffData`; points go the way that cameras go.

    Sources: LLFF's load_llff_data; Eikonal Fields' load_llff.py.
    """
    if frame == "file":
        return np.eye(4)
    scale = 1 / (_LLFF_BOUND_FACTOR * depths.min() if frame == "llff" else depths.max() - depths.min())
    transform = np.diag([scale, scale, scale, 1.0])
    transform = _recentre(map_poses(poses, transform)) @ transform
    if frame == "eikonal":
        transform = _spherify(map_poses(poses, transform)) @ transform
    return transform


def map_poses(poses: Float[np.ndarray, "V 3 4"], transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "V 3 4"]:
    """Poses in another world; the scale moves centres and leaves rotations."""
    mapped = transform[:3, :3] @ poses
    mapped[:, :, :3] /= np.cbrt(np.linalg.det(transform[:3, :3]))
    mapped[:, :, 3] += transform[:3, 3]
    return mapped


def _recentre(poses: Float[np.ndarray, "V 3 4"]) -> Float[np.ndarray, "4 4"]:
    """To the frame of the average camera."""
    back = _unit(poses[:, :, 2].sum(0))
    right = _unit(np.cross(poses[:, :, 1].sum(0), back))
    up = np.cross(back, right)
    return _inverse(np.stack([right, up, back], -1), poses[:, :, 3].mean(0))


def _spherify(poses: Float[np.ndarray, "V 3 4"]) -> Float[np.ndarray, "4 4"]:
    """To the point nearest all optical axes as origin, z towards the cameras' mean, root mean square distance 1."""
    axes, centres = poses[:, :, 2], poses[:, :, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projects out the axis
    matrix = across.mean(0)
    if np.linalg.cond(matrix) > 1e8:
        raise NerfroError("data.frame=eikonal: all cameras look the same way, so their axes meet nowhere; take llff")
    origin = np.linalg.solve(matrix, (across @ centres[:, :, None])[:, :, 0].mean(0))
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
