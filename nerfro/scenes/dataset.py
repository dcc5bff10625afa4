"""A rendered scene as a folder in Blender format, written so that an interrupted run can be continued."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.images import save_picture
from nerfro.light import to_srgb
from nerfro.scenes.scene import Scene
from nerfro.scenes.skies import lat_long_directions
from nerfro.scenes.viewpoints import directions_on_sphere, look_at_origin

CAMERA_ANGLE_X = 0.6911112070083618  # the camera of the NeRF synthetic scenes, which the paper's scenes share
CAMERA_DISTANCE = 4.03
NEAR, FAR = 2.0, 6.0
BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
SPLITS = ("train", "val", "test")
META = "meta.json"
_FILES = (
    *(f"transforms_{split}.json" for split in SPLITS),
    *(f"{folder}{split}/r_*.png" for split in SPLITS for folder in ("", "masks/")),
    *("mesh.ply", "interior.ply", "sky.png", "sky.exr", META),
)


@dataclass(frozen=True)
class Settings:
    """Everything that decides the contents of the pictures; a folder is continued only with equal settings.

    Attributes:
        scene: name of the scene.
        fingerprint: hash of its geometry, colours and sky, so that pictures of an older model are not mixed in.
        resolution: side of the square pictures, pixels.
        spp: samples per pixel of training and validation views.
        test_spp: samples per pixel of test views.
        views: number of views per split.
        fresnel: whether the glass reflects partially.
        seed: seed of viewpoints and of the sampler.
    """

    scene: str
    fingerprint: str
    resolution: int
    spp: int
    test_spp: int
    views: dict[str, int]
    fresnel: bool
    seed: int


@dataclass(frozen=True)
class Planned:
    """A picture that is to be rendered.

    Attributes:
        image_path, mask_path: where it and its mask go within the folder.
        pose: camera-to-world matrix [4, 4], OpenGL axes.
        spp: samples per pixel.
        seed: of the sampler (and of noise), different for every picture.
    """

    image_path: str
    mask_path: str
    pose: np.ndarray
    spp: int
    seed: int


def fingerprint(scene: Scene) -> str:
    """Return a short hash of a scene's geometry, colours, index, tint and surroundings."""
    digest = hashlib.sha256(repr((scene.ior, scene.tint)).encode())
    for surface in (scene.glass, scene.interior):
        for array in (surface.vertices, surface.faces, surface.normals, surface.colours):
            if array is not None:
                digest.update(array.tobytes())
    if scene.sky is not None:
        digest.update(scene.sky(lat_long_directions(64, 128)).astype(np.float32).tobytes())
    for panel in scene.panels:
        digest.update(repr((panel.to_world.tolist(), panel.glows, panel.smooth)).encode() + panel.picture.tobytes())
    return digest.hexdigest()[:16]


def views(settings: Settings) -> list[Planned]:
    """Return every view of a data set, in the order in which they are rendered."""
    planned = []
    for number, split in enumerate(SPLITS):
        directions = directions_on_sphere(settings.views[split], settings.seed, number)
        spp = settings.test_spp if split == "test" else settings.spp
        for index, direction in enumerate(directions):
            pose = look_at_origin(CAMERA_DISTANCE * direction)
            seed, name = (settings.seed * 3 + number) * 100_000 + index, f"{split}/r_{index:03d}.png"
            planned.append(Planned(name, f"masks/{name}", pose, spp, seed))
    return planned


def prepare(folder: Path, settings: Any, overwrite: bool, meta: str = META, files: tuple[str, ...] = _FILES) -> None:
    """Make `folder` ready for pictures of `settings`: new, continued, or cleared.

    Args:
        folder: of the data set.
        settings: dataclass of everything that decides the contents.
        overwrite: whether another data set may be replaced.
        meta: file in the folder in which a data set's settings stand.
        files: patterns of the files that a data set consists of.

    Raises:
        NerfroError: the folder holds another data set, or other files, and `overwrite` is not set.
    """
    stored = _stored_settings(folder / meta)
    if stored is not None:
        if stored == asdict(settings):
            return
        if not overwrite:
            raise NerfroError(
                f"'{folder}' holds a data set with other settings; choose another folder with out=DIR, "
                "or replace it with overwrite=true"
            )
        # Nothing else, that somebody may have put beside them.
        for path in [path for pattern in files for path in folder.glob(pattern)]:
            path.unlink()
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise NerfroError(f"'{folder}' exists and is no data set of ours; choose another folder with out=DIR")
    folder.mkdir(parents=True, exist_ok=True)


def missing(folder: Path, planned: list[Planned]) -> Iterator[Planned]:
    """Yield those whose picture or mask is not on disk yet."""
    for picture in planned:
        if not ((folder / picture.image_path).is_file() and (folder / picture.mask_path).is_file()):
            yield picture


def write_view(folder: Path, view: Planned, radiance: np.ndarray, silhouette: np.ndarray) -> None:
    """Write one view: 8-bit pictures of linear radiance [H, W, 3], in sRGB, and of the share of pixels [H, W]."""
    write_image(folder / view.mask_path, silhouette)
    write_image(folder / view.image_path, to_srgb(radiance))


def write_image(path: Path, image: np.ndarray) -> None:
    """Write sRGB [H, W, 3] or shares [H, W], clipped to [0, 1], as an 8-bit PNG, or bool [H, W] as a 1-bit PNG."""
    levels = image if image.dtype == bool else np.rint(np.clip(image, 0.0, 1.0) * 255).astype(np.uint8)
    save_picture(path, Image.fromarray(levels), optimize=True)


def write_meta(folder: Path, settings: Settings, scene: Scene, versions: dict[str, str]) -> None:
    """Write meta.json: what the folder holds and how it came about."""
    meta = {
        "scene": scene.name,
        "ior": scene.ior,
        "tint": list(scene.tint),
        "box": BOX,
        "near": NEAR,
        "far": FAR,
        "camera_distance": CAMERA_DISTANCE,
        "sky": "lat-long, z up: column u = 0.5 - atan2(y, x) / (2 pi), row v = acos(z) / pi, pixel centres + 0.5",
        "masks": "share of the pixel that the glass covers",
        "settings": asdict(settings),
        "versions": versions,
    }
    write_atomically(folder / META, json.dumps(meta, indent=1) + "\n")


def write_transforms(folder: Path, planned: list[Planned]) -> None:
    """Write transforms_{train,val,test}.json; done last, as their presence says that the pictures are complete."""
    for split in SPLITS:
        frames = [
            {
                "file_path": "./" + view.image_path.removesuffix(".png"),
                "mask_path": "./" + view.mask_path,
                "transform_matrix": view.pose.tolist(),
            }
            for view in planned
            if view.image_path.startswith(f"{split}/")
        ]
        content = json.dumps({"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}, indent=1)
        write_atomically(folder / f"transforms_{split}.json", content + "\n")


def _stored_settings(meta: Path) -> dict | None:
    """Return the settings in a meta.json, or None when there is none or it is not one of ours."""
    try:
        return json.loads(meta.read_text()).get("settings")
    except (FileNotFoundError, NotADirectoryError, ValueError, AttributeError):
        return None
