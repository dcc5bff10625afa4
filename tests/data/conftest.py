"""Small data sets on disk."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

Writer = Callable[..., Path]


def _random_image(seed: int, width: int = 8, height: int = 6, num_channels: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, num_channels), dtype=np.uint8)


@pytest.fixture
def random_image() -> Callable[..., np.ndarray]:
    """8-bit levels [H, W, C] of a seed, 8x6 RGB by default; H, W and C may be given."""
    return _random_image


@pytest.fixture
def write_blender(tmp_path: Path, random_pose: Callable[[int], np.ndarray]) -> Writer:
    """Write a split in the Blender format: a file for each image [H, W, C], and the folder is returned."""

    def write(
        images: Sequence[np.ndarray],
        poses: Sequence[np.ndarray] | None = None,
        masks: Sequence[np.ndarray] = (),
        split: str = "train",
        angle: float = math.pi / 2,
        suffix: str = "",
    ) -> Path:
        (tmp_path / split).mkdir()
        frames = []
        for i, image in enumerate(images):
            Image.fromarray(image).save(tmp_path / split / f"r_{i}.png")
            pose = random_pose(i) if poses is None else poses[i]
            frames.append({"file_path": f"./{split}/r_{i}{suffix}", "rotation": 0.1, "transform_matrix": pose.tolist()})
        for i, mask in enumerate(masks):
            Image.fromarray(mask).save(tmp_path / split / f"mask_r_{i}.png")
        document = {"camera_angle_x": angle, "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(document))
        return tmp_path

    return write


@pytest.fixture
def edit_transforms() -> Callable[[Path, Callable[[dict], None]], None]:
    """Change the content of a folder's transforms_train.json."""

    def edit(root: Path, change: Callable[[dict], None]) -> None:
        path = root / "transforms_train.json"
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))

    return edit
