"""Data in NeRRF's layouts."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfro.allowed import Distance, Factor
from nerfro.data.base import Frame, Views
from nerfro.data.frames import Lens, PosedImages, check_pose, list_images
from nerfro.data.image_files import Alpha
from nerfro.data.transforms import is_number, parse_matrix, read_json
from nerfro.errors import NerfroError
from nerfro.registry import register

# Constants of NeRRF's dataloader.py: the synthetic field of view, the size for which `f` is given, and its split.
_FIELD_OF_VIEW = math.radians(60)
_EIKONAL_SIZE = (672, 504)
_EIKONAL_TRAIN = 50


@register("data", "nerrf")
class NerrfData(PosedImages):
    """NeRRF's synthetic scenes, and its version of the Eikonal Fields scenes; OpenGL axes.

    Synthetic: `<id>_0001.png`, `../../meta/<id>_meta_0000.json` and `../../mask/<name of root>/mask_<id>_0001.png`;
    even ids are trained on, odd ones are val and test. Eikonal: `images/<name>.JPG`, `meta/<name>.json` with the focal
    length `f`, `mask/mask_<name>.png`; the first 50 by name are trained on (in NeRRF in the order of its disk).

    Args:
        root: folder of a scene's images (synthetic), or the one that holds images/, meta/ and mask/.
        near, far, downscale, alpha: see `PosedImages`; `far` none takes NeRRF's, 80 for synthetic scenes, else 3.
    """

    def __init__(
        self,
        root: str,
        near: Distance = 0.02,
        far: Distance | None = None,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
    ) -> None:
        super().__init__(root, near, far, downscale, alpha)

    def load(self, split: str) -> Views:
        self.require(split)
        captured = (self.root / "images").is_dir()
        images = _captured_images(self.root, split) if captured else _synthetic_images(self.root, split)
        frames, focals = [], []
        for image, meta, mask in images:
            pose, focal = _read_meta(meta, captured)
            frames.append(Frame(image.name, image, mask if mask.is_file() else None, pose))
            focals.append(focal)

        def lenses(width: int, height: int) -> list[Lens]:
            if not captured:
                return [Lens.of_angle(_FIELD_OF_VIEW, width, height)] * len(frames)
            full = (Lens(focal, focal, 0.5 * _EIKONAL_SIZE[0], 0.5 * _EIKONAL_SIZE[1]) for focal in focals)
            return [lens.resized(_EIKONAL_SIZE, (width, height), f"{self.root / 'meta'}") for lens in full]

        return self.views(frames, lenses, "opengl", farthest=3.0 if captured else 80.0)


def _synthetic_images(root: Path, split: str) -> list[tuple[Path, Path, Path]]:
    """Image, pose file and mask of each view of a split."""
    base = root.resolve().parent.parent
    numbers = sorted(int(path.stem[:-5]) for path in root.glob("*_0001.png") if path.stem[:-5].isdigit())
    chosen = [number for number in numbers if (number % 2 == 0) == (split == "train")]
    if not chosen:
        raise NerfroError(f"data.root={root} has no image <id>_0001.png of {'even' if split == 'train' else 'odd'} id")
    masks = base / "mask" / root.resolve().name
    return [
        (root / f"{i}_0001.png", base / "meta" / f"{i}_meta_0000.json", masks / f"mask_{i}_0001.png") for i in chosen
    ]


def _captured_images(root: Path, split: str) -> list[tuple[Path, Path, Path]]:
    images = list_images(root / "images")
    images = images[:_EIKONAL_TRAIN] if split == "train" else images[_EIKONAL_TRAIN:]
    if not images:
        raise NerfroError(f"{root / 'images'} holds no more than the {_EIKONAL_TRAIN} images that are trained on")
    return [(image, root / "meta" / f"{image.stem}.json", root / "mask" / f"mask_{image.stem}.png") for image in images]


def _read_meta(path: Path, captured: bool) -> tuple[Float[np.ndarray, "3 4"], float]:
    """Pose and, for captured scenes, focal length in pixels."""
    document = read_json(path, "every image needs its pose")
    for key in ["cam_world_pose", *(["f"] if captured else [])]:
        if not isinstance(document, dict) or key not in document:
            raise NerfroError(f"{path} has no '{key}'; see docs/data.md for the layout")
    pose = parse_matrix(document["cam_world_pose"], ((4, 4), (3, 4)), f"{path}: cam_world_pose")
    focal = document["f"] if captured else 1.0
    if not is_number(focal) or focal <= 0:
        raise NerfroError(f"{path}: f={focal!r} must be a focal length in pixels")
    return check_pose(pose, str(path), "cam_world_pose"), float(focal)
