"""Camera poses and output folder of a rendered scene: views in Blender format, or photographs.

An interrupted rendering resumes.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import torch
import trimesh
from PIL import Image

from nerfro.cli.overrides import as_overrides, command_line
from nerfro.core.errors import NerfroError
from nerfro.core.light import to_srgb
from nerfro.data.base import SPLITS
from nerfro.files import lat_long
from nerfro.files.atomic import require_only, write_json
from nerfro.files.images import save_image, write_radiance
from nerfro.files.reading import read_json
from nerfro.geometry.normals import fibonacci_lattice
from nerfro.synthetic.path_tracer import Pinhole
from nerfro.synthetic.scene import SyntheticScene, lat_long_texture


def directions_on_sphere(count: int, seed: int, split: int) -> np.ndarray:
    """Return well-spread unit directions [count, 3]: a Fibonacci lattice, turned at random and jittered.

    Each `split` of the data set of a `seed` gets its own rotation, so no test view repeats a training view.
    """
    generator = np.random.default_rng([seed, split])
    lattice = fibonacci_lattice(count)
    turn = trimesh.transformations.random_rotation_matrix(generator.random(3))[:3, :3]
    spacing = np.sqrt(4 * np.pi / count)
    jittered = lattice @ turn.T + 0.2 * spacing * generator.normal(size=lattice.shape)
    jittered = jittered / np.linalg.norm(jittered, axis=1, keepdims=True)
    return generator.permutation(jittered)


def directions_on_ring(count: int, seed: int, split: int, elevation: float = 25.0) -> np.ndarray:
    """Return evenly spaced unit directions [count, 3] at an elevation in degrees, from a random azimuth per split."""
    turn = np.random.default_rng([seed, split]).random()
    phi, theta = 2 * np.pi * (np.arange(count) + turn) / count, np.radians(elevation)
    return np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.full(count, np.sin(theta))], -1)


def look_at_origin(position: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix [4, 4] (OpenGL axes: x right, y up, looks along -z) of a camera at `position`.

    World z is up in the image, except directly above and below the origin, where world y is up.
    """
    backward = position / np.linalg.norm(position)
    up = np.array([0.0, 0.0, 1.0]) if abs(backward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(backward, right), backward, position], -1)
    return pose


CAMERA_ANGLE_X = 0.6911112070083618  # field of view of the NeRF synthetic scenes and of the paper's scenes
CAMERA_DISTANCE = 4.03


@dataclass(frozen=True)
class PlannedImage:
    """An image that has to be rendered.

    Attributes:
        image_path, mask_path: paths of image and mask within the folder.
        pose: camera-to-world matrix [4, 4], OpenGL axes.
        spp: samples per pixel.
        seed: seed of the sampler (and of noise), different for every image.
    """

    image_path: str
    mask_path: str
    pose: np.ndarray
    spp: int
    seed: int

    def frame(self, folder: str, pose: np.ndarray) -> dict[str, Any]:
        """Return the entry of the image in a transforms file, from which `folder` is the path to the data set."""
        paths = {"file_path": f"{folder}/{self.image_path}", "mask_path": f"{folder}/{self.mask_path}"}
        return {**paths, "transform_matrix": pose.tolist()}


@dataclass(frozen=True)
class DataSet(ABC):
    """Images of a scene in a folder; `options` is a `SynthesizeConfig`."""

    options: Any
    scene: SyntheticScene
    folder: Path

    META: ClassVar[str]  # file with the settings
    FILES: ClassVar[tuple[str, ...]]  # patterns of all files
    FACTS: ClassVar[dict[str, Any]] = {}  # further content of META
    OPTIONS: ClassVar[tuple[str, ...]]  # options that change the images
    NOUN: ClassVar[str]
    WIDTH: ClassVar[float]  # width of an image in the plane through the object, world units

    @property
    @abstractmethod
    def camera(self) -> Pinhole:
        """Camera of all images."""

    @abstractmethod
    def planned(self) -> list[PlannedImage]:
        """Return all images in the order of rendering."""

    @abstractmethod
    def write(self, image: PlannedImage, radiance: np.ndarray, coverage: np.ndarray) -> None:
        """Write an image of linear radiance [H, W, 3], and a mask of the covered fraction of each pixel [H, W]."""

    @abstractmethod
    def finish(self, planned: list[PlannedImage]) -> None:
        """Write the files that belong to the images; the cameras come last and mark the data set as complete."""

    @abstractmethod
    def next_command(self) -> str:
        """Return what to do with the data set, with the command."""

    def lit(self) -> SyntheticScene:
        """Return the scene as the renderer receives the scene."""
        return self.scene

    def prepare(self, mitsuba: ModuleType) -> None:
        """Create the folder, keep a folder with equal settings, or remove the files of another data set.

        Raises:
            NerfroError: the folder contains other files, or another data set while `overwrite` is false.
        """
        options = asdict(self.options)
        settings = {"scene": self.options.scene, "fingerprint": fingerprint(self.scene)}
        settings |= {name: options[name] for name in self.OPTIONS}
        try:
            stored = read_json(self.folder / self.META, "").get("settings")
        except (NerfroError, AttributeError):
            stored = None
        if stored == settings:
            return
        if stored is not None:
            if not self.options.overwrite:
                raise NerfroError(
                    f"'{self.folder}' holds a data set with other settings; choose another folder with out=DIR, "
                    "or replace the data set with overwrite=true"
                )
            # Other files in the folder may belong to the user.
            for path in [path for pattern in self.FILES for path in self.folder.glob(pattern)]:
                path.unlink()
        else:
            require_only(self.folder, (), "it is no data set of nerfro; choose another folder with out=DIR")
        versions = {name: importlib.metadata.version(name) for name in ("mitsuba", "drjit", "numpy")}
        versions |= {"python": platform.python_version(), "variant": mitsuba.variant()}
        meta = {"scene": self.options.scene, "ior": self.scene.ior, "tint": list(self.scene.tint)}
        meta |= {"absorption": list(self.scene.absorption), **self.FACTS}
        write_json(self.folder / self.META, {**meta, "settings": settings, "versions": versions})

    def missing(self, planned: list[PlannedImage]) -> list[PlannedImage]:
        """Return the images without file or mask."""
        return [
            image
            for image in planned
            if not all((self.folder / path).is_file() for path in (image.image_path, image.mask_path))
        ]


class ViewSplits(DataSet):
    """Views from all sides in Blender format, in splits."""

    META = "meta.json"
    FILES: ClassVar[tuple[str, ...]] = (
        *(f"transforms_{split}.json" for split in SPLITS),
        *(f"{split}/r_*.{suffix}" for split in SPLITS for suffix in ("png", "exr")),
        *(f"masks/{split}/r_*.png" for split in SPLITS),
        *("mesh.ply", "interior.ply", "sky.png", "sky.exr", META),
    )
    FACTS: ClassVar[dict[str, Any]] = {"box": ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5)), "near": 2.0, "far": 6.0}
    OPTIONS: ClassVar[tuple[str, ...]] = (
        *("resolution", "spp", "test_spp", "views", "fresnel", "seed", "format"),
        *("cameras", "turntable"),
    )
    NOUN = "views"
    WIDTH = CAMERA_DISTANCE * CAMERA_ANGLE_X

    @property
    def camera(self) -> Pinhole:
        return Pinhole.square(self.angle_x, self.options.resolution)

    @property
    def angle_x(self) -> float:
        """Horizontal field of view, radians."""
        return CAMERA_ANGLE_X

    def planned(self) -> list[PlannedImage]:
        planned = []
        for number, split in enumerate(SPLITS):
            spp = self.options.test_spp if split == "test" else self.options.spp
            drawn = getattr(self.options.views, split), self.options.seed, number
            is_ring = self.options.cameras == "ring"
            directions = directions_on_ring(*drawn) if is_ring else directions_on_sphere(*drawn)
            if self.options.cameras == "above":
                directions[:, 2] = np.abs(directions[:, 2])
            for index, direction in enumerate(directions):
                pose = look_at_origin(CAMERA_DISTANCE * direction)
                seed, name = (self.options.seed * 3 + number) * 100_000 + index, f"{split}/r_{index:03d}"
                planned.append(self._planned(name, pose, spp, seed))
        return planned

    def _planned(self, name: str, pose: np.ndarray, spp: int, seed: int) -> PlannedImage:
        return PlannedImage(f"{name}.{self.options.format}", f"masks/{name}.png", pose, spp, seed)

    def write(self, image: PlannedImage, radiance: np.ndarray, coverage: np.ndarray) -> None:
        write_image(self.folder / image.mask_path, coverage)
        if self.options.format == "exr":
            write_radiance(self.folder / image.image_path, radiance)
        else:
            write_image(self.folder / image.image_path, to_srgb(radiance))

    def finish(self, planned: list[PlannedImage]) -> None:
        assert self.scene.sky is not None
        sky = lat_long_texture(self.scene.sky, self.options.sky_height)
        self.scene.glass.save(self.folder / "mesh.ply")
        write_image(self.folder / "sky.png", to_srgb(sky))
        if self.options.extras:
            if len(self.scene.interior.faces):
                self.scene.interior.save(self.folder / "interior.ply")
            lat_long.save_lat_long(self.folder / "sky.exr", torch.from_numpy(sky))
        for split in SPLITS:
            frames = [
                view.frame(".", view.pose) | {"file_path": "./" + view.image_path.removesuffix(".png")}
                for view in planned
                if view.image_path.startswith(f"{split}/")
            ]
            content = {"camera_angle_x": self.angle_x, "frames": frames}
            if self.options.turntable:
                # With an axis, cameras at several heights see the same room.
                content |= {"turntable": True} if self.options.cameras == "ring" else {"turntable_axis": [0, 0, 1]}
            write_json(self.folder / f"transforms_{split}.json", content)

    def next_command(self) -> str:
        mesh = self.folder / "mesh.ply"
        options = as_overrides({"data.root": self.folder, "medium.mesh": mesh, "medium.ior": self.scene.ior})
        return f"train on it: {command_line('train', options)}"


def fingerprint(scene: SyntheticScene) -> str:
    """Compute a short hash of a scene, so that images of different scenes are not mixed in one folder."""
    digest = hashlib.sha256(repr((scene.ior, scene.tint, scene.absorption)).encode())
    for part in scene.parts:
        properties = (part.name, part.ior, part.absorption, part.outer_ior, part.outer_absorption, part.albedo)
        digest.update(repr(properties).encode())
    textures = [part.texture.tobytes() for part in scene.parts if part.texture is not None]
    digest.update(b"".join(textures))
    for surface in (scene.glass, scene.interior):
        for array in (surface.vertices, surface.faces, surface.normals, surface.colours):
            if array is not None:
                digest.update(array.tobytes())
    if scene.sky is not None:
        digest.update(scene.sky(lat_long.directions(64).numpy()).astype(np.float32).tobytes())
    for panel in scene.panels:
        digest.update(repr((panel.to_world.tolist(), panel.glows, panel.smooth)).encode() + panel.image.tobytes())
    return digest.hexdigest()[:16]


def write_image(path: Path, image: np.ndarray) -> None:
    """Write sRGB [H, W, 3] or coverage [H, W], clipped to [0, 1], as an 8-bit PNG, or bool [H, W] as a 1-bit PNG."""
    levels = image if image.dtype == bool else np.rint(np.clip(image, 0.0, 1.0) * 255).astype(np.uint8)
    save_image(path, Image.fromarray(levels), optimize=True)
