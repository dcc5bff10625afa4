"""Template: a data format of your own in one file. Use it with `data=numpy_views data.root=DIR`.

DIR contains `train.npz` and `test.npz` with the arrays `images` [V, H, W, 3], 8-bit sRGB; `poses` [V, 3, 4], from
camera to world with OpenGL axes; and `focal`, pixels.
"""

from __future__ import annotations

import numpy as np
import torch

from nerfro.parts import Cameras, DataSource, Distance, NerfroError, Views, load_arrays, register, resolve_path


@register("data", "numpy_views")
class NumpyViews(DataSource):
    """Read images and cameras from one NumPy file for each split.

    Args:
        root: folder of the data set.
        near, far: bounds of the rays, arc lengths in world units.
    """

    def __init__(self, root: str, near: Distance = 2.0, far: Distance = 6.0) -> None:
        self.root, self.near, self.far = resolve_path(root), near, far

    @property
    def splits(self) -> list[str]:
        return sorted(file.stem for file in self.root.glob("*.npz"))

    def load(self, split: str) -> Views:
        if split not in self.splits:
            raise NerfroError(f"{self.root} has no file {split}.npz; it has the splits {', '.join(self.splits)}")
        arrays = load_arrays(self.root / f"{split}.npz")
        images = torch.from_numpy(arrays["images"]).float() / 255
        num_views, height, width, _ = images.shape
        focal = torch.full((num_views,), float(arrays["focal"]))
        cx, cy = torch.full_like(focal, width / 2), torch.full_like(focal, height / 2)
        poses = arrays["poses"].astype(np.float64)
        poses[:, :, 3] -= self.origin  # the object may be far from the origin of the world
        cameras = Cameras(torch.from_numpy(poses).float(), focal, focal, cx, cy, width, height, self.near, self.far)
        return Views(cameras, images, None, [f"view_{view:03d}" for view in range(num_views)])
