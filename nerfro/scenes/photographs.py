"""A capture as a folder: photographs and masks as somebody brings them home, and apart from them the truth."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from nerfro.files.atomic import write_atomically
from nerfro.light import to_srgb
from nerfro.scenes.dataset import Planned, write_image
from nerfro.scenes.path_tracer import Pinhole
from nerfro.scenes.scene import Scene
from nerfro.scenes.viewpoints import hand_held

IMAGES, MASKS, TRUTH = "images", "masks", "truth"
META = f"{TRUTH}/meta.json"
FILES = (
    f"{IMAGES}/photo_*.png",
    f"{MASKS}/photo_*.png",
    *(f"{TRUTH}/{name}" for name in ("transforms_train.json", "mesh.ply", "interior.ply", "meta.json")),
)
DISTANCE, ELEVATIONS, LAPS = 4.5, (5.0, 68.0), 4
# Of the width, and in shares of it from the picture's centre: no lens sits exactly in front of the middle.
FOCAL, OFF_CENTRE = 1.18, (0.006, -0.005)


@dataclass(frozen=True)
class Settings:
    """Everything that decides the contents of the pictures; a folder is continued only with equal settings.

    Attributes:
        scene: name of the scene.
        fingerprint: hash of it, see `nerfro.scenes.dataset.fingerprint`.
        resolution: width of the photographs, pixels; they are 4:3.
        photographs: how many.
        spp: samples per pixel.
        noise: standard deviation of the sensor's noise, of sRGB values in [0, 1].
        fresnel: whether the glass reflects partially.
        seed: of viewpoints, sampler and noise.
    """

    scene: str
    fingerprint: str
    resolution: int
    photographs: int
    spp: int
    noise: float
    fresnel: bool
    seed: int


def camera(resolution: int) -> Pinhole:
    """The camera whose pictures are `resolution` pixels wide."""
    height = resolution * 3 // 4
    cx, cy = 0.5 * resolution + OFF_CENTRE[0] * resolution, 0.5 * height + OFF_CENTRE[1] * resolution
    return Pinhole(resolution, height, FOCAL * resolution, cx, cy)


def photographs(settings: Settings, target: np.ndarray) -> list[Planned]:
    """Return all photographs of a capture around `target`, in the order in which they are taken."""
    poses = hand_held(settings.photographs, settings.seed, target, DISTANCE, ELEVATIONS, LAPS)
    return [
        Planned(
            f"{IMAGES}/photo_{index:03d}.png",
            f"{MASKS}/photo_{index:03d}.png",
            pose,
            settings.spp,
            settings.seed * 100_000 + index,
        )
        for index, pose in enumerate(poses)
    ]


def write_photograph(
    folder: Path, photograph: Planned, radiance: np.ndarray, silhouette: np.ndarray, noise: float
) -> None:
    """Write one photograph: linear radiance [H, W, 3] as 8-bit sRGB with noise, and a mask in black and white.

    Noise of equal strength on sRGB values is about what the noise of counted photons becomes under sRGB's curve.
    """
    grain = np.random.default_rng(photograph.seed).normal(scale=noise, size=radiance.shape)
    write_image(folder / photograph.mask_path, silhouette >= 0.5)
    write_image(folder / photograph.image_path, to_srgb(np.clip(radiance, 0.0, 1.0)) + grain)


def write_truth(folder: Path, planned: list[Planned], settings: Settings, scene: Scene) -> None:
    """Write the true surface, and the true cameras as data of the format `opencv`; last, as a sign of completeness."""
    lens = camera(settings.resolution)
    scene.glass.save(folder / TRUTH / "mesh.ply")
    scene.interior.save(folder / TRUTH / "interior.ply")
    frames = [
        {
            "file_path": f"../{photograph.image_path}",
            "mask_path": f"../{photograph.mask_path}",
            "transform_matrix": (photograph.pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        }
        for photograph in planned
    ]
    matrix = [[lens.focal, 0.0, lens.cx], [0.0, lens.focal, lens.cy], [0.0, 0.0, 1.0]]
    content = {"cam_mat": matrix, "w": lens.width, "h": lens.height, "frames": frames}
    write_atomically(folder / TRUTH / "transforms_train.json", json.dumps(content, indent=1) + "\n")


def write_meta(folder: Path, settings: Settings, scene: Scene, versions: dict[str, str]) -> None:
    """Write truth/meta.json: what the folder holds and how it came about."""
    meta = {"scene": scene.name, "ior": scene.ior, "settings": asdict(settings), "versions": versions}
    write_atomically(folder / META, json.dumps(meta, indent=1) + "\n")
