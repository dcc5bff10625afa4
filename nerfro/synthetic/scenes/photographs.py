"""Photographs of a scene as from a real capture, held by hand and without poses, in precomputed light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from skimage.transform import resize

from nerfro.cli.overrides import as_overrides, command_line
from nerfro.core.light import to_linear, to_srgb
from nerfro.files.atomic import write_json
from nerfro.synthetic.dataset import DataSet, PlannedImage, look_at_origin, write_image
from nerfro.synthetic.path_tracer import PathTracer, Pinhole
from nerfro.synthetic.scene import Panel, SyntheticScene, Vector

DISTANCE, ELEVATIONS, LAPS = 4.5, (5.0, 68.0), 4
# Focal length, and offset of the principal point from the centre of the image, relative to the width of the image.
FOCAL, OFF_CENTRE = 1.18, (0.006, -0.005)
BAKING_SPP = 256


class Photographs(DataSet):
    """Photographs and masks without poses, as from a real capture; the true poses and surfaces are in `truth/`."""

    META = "truth/meta.json"
    FILES = (
        *("images/photo_*.png", "masks/photo_*.png"),
        *(f"truth/{name}" for name in ("transforms_train.json", "mesh.ply", "interior.ply", "meta.json")),
    )
    OPTIONS = ("resolution", "photographs", "spp", "noise", "fresnel", "seed")
    NOUN = "photographs"
    WIDTH = DISTANCE / FOCAL

    @property
    def camera(self) -> Pinhole:
        width, height = self.options.resolution, self.options.resolution * 3 // 4
        cx, cy = 0.5 * width + OFF_CENTRE[0] * width, 0.5 * height + OFF_CENTRE[1] * width
        return Pinhole(width, height, FOCAL * width, cx, cy)

    def lit(self) -> SyntheticScene:
        return bake(self.scene, BAKING_SPP, self.options.variant)

    def planned(self) -> list[PlannedImage]:
        options = self.options
        poses = hand_held(options.photographs, options.seed, self.scene.aim, DISTANCE, ELEVATIONS, LAPS)
        return [
            PlannedImage(f"images/{name}", f"masks/{name}", pose, options.spp, options.seed * 100_000 + index)
            for index, pose in enumerate(poses)
            for name in [f"photo_{index:03d}.png"]
        ]

    def write(self, image: PlannedImage, radiance: np.ndarray, coverage: np.ndarray) -> None:
        """Write 8-bit sRGB with noise, and a mask in black and white.

        Noise of constant strength in sRGB approximates the noise of counted photons after encoding.
        """
        grain = np.random.default_rng(image.seed).normal(scale=self.options.noise, size=radiance.shape)
        write_image(self.folder / image.mask_path, coverage >= 0.5)
        write_image(self.folder / image.image_path, to_srgb(np.clip(radiance, 0.0, 1.0)) + grain)

    def finish(self, planned: list[PlannedImage]) -> None:
        """Write the true surfaces, and the true cameras in the format `opencv`."""
        camera, truth = self.camera, self.folder / "truth"
        self.scene.glass.save(truth / "mesh.ply")
        self.scene.interior.save(truth / "interior.ply")
        frames = [image.frame("..", image.pose @ np.diag([1.0, -1.0, -1.0, 1.0])) for image in planned]
        matrix = [[camera.focal, 0.0, camera.cx], [0.0, camera.focal, camera.cy], [0.0, 0.0, 1.0]]
        content = {"cam_mat": matrix, "w": camera.width, "h": camera.height, "frames": frames}
        write_json(truth / "transforms_train.json", content)

    def next_command(self) -> str:
        options = as_overrides({"images": self.folder / "images", "target": "apriltag", "out": self.folder})
        return f"calibrate it: {command_line('calibrate', options)}"


def hand_held(
    count: int, seed: int, target: Vector, distance: float, elevations: tuple[float, float], laps: int
) -> list[np.ndarray]:
    """Return the poses of a photographer who climbs around the object in `laps` laps, none of them exactly.

    Args:
        count: number of photographs.
        seed: of what is not exact: direction, distance and aim (some per cent), and roll (6 degrees).
        target: what the camera looks at, world units.
        distance: distance of the camera from the target, world units.
        elevations: lowest and highest above the target, degrees; equal areas in between get equally many photographs.
        laps: number of times around.

    Returns:
        Camera-to-world matrices [4, 4], OpenGL axes, in the order in which they are taken.
    """
    generator = np.random.default_rng(seed)
    low, high = np.sin(np.radians(elevations))
    poses = []
    for index in range(count):
        share = (index + 0.5) / count
        azimuth = 2 * np.pi * (laps * share + 0.02 * generator.normal())
        height = np.clip(low + (high - low) * (share + 0.03 * generator.normal()), low, high)
        level = np.sqrt(1 - height**2)
        direction = np.array([level * np.cos(azimuth), level * np.sin(azimuth), height])
        pose = look_at_origin(distance * generator.uniform(0.95, 1.05) * direction)
        pose[:3, 3] += np.asarray(target) + 0.02 * distance * generator.uniform(-1, 1, 3)
        roll = np.radians(6.0) * generator.uniform(-1, 1)
        right, up = pose[:3, 0].copy(), pose[:3, 1].copy()
        pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * up
        pose[:3, 1] = np.cos(roll) * up - np.sin(roll) * right
        poses.append(pose)
    return poses


TEXELS = 16  # resolution of the light on a panel
_ABOVE = 2e-3  # world units; more than the offsets of the renderer, less than the gap under the globe


def bake(scene: SyntheticScene, spp: int, variant: str = "auto") -> SyntheticScene:
    """Replace the reflected light of panels by emitted light, so that shading and shadows have no noise.

    The radiance of a panel is independent of the direction, because panels are diffuse. During the computation, each
    panel has its mean colour; light that panels reflect onto each other has no finer pattern.

    Args:
        scene: scene with panels.
        spp: samples for each of `TEXELS` x `TEXELS` positions on a panel.
        variant: Mitsuba variant, see `load_mitsuba`.
    """
    plain = [panel if panel.glows else replace(panel, image=_mean(panel)) for panel in scene.panels]
    tracer = PathTracer(replace(scene, panels=tuple(plain)), False, Pinhole.square(1.0, TEXELS), variant)
    baked = []
    for number, (panel, mean) in enumerate(zip(scene.panels, plain, strict=True)):
        if not panel.glows:
            light = _light(tracer, panel, spp, number) / to_linear(mean.image[:1, :1])
            fine = resize(light, panel.image.shape, order=1, mode="edge", anti_aliasing=False)
            lit = np.clip(fine * to_linear(panel.image), 0.0, 1.0)
            panel = replace(panel, image=to_srgb(lit).astype(np.float32), glows=True)
        baked.append(panel)
    return replace(scene, panels=tuple(baked))


def _light(tracer: PathTracer, panel: Panel, spp: int, seed: int) -> np.ndarray:
    """Return the linear radiance [TEXELS, TEXELS, 3] of a panel along its normal."""
    pose = panel.to_world
    pose[:3, 3] += _ABOVE * pose[:3, 2]
    sensor = {"type": "orthographic", "near_clip": 0.1 * _ABOVE, "far_clip": 10.0 * _ABOVE}
    return tracer.render_sensor(sensor, pose, spp, seed)


def _mean(panel: Panel) -> np.ndarray:
    """Return an image [2, 2, 3] of the mean linear colour of a panel."""
    return np.tile(to_srgb(to_linear(panel.image).mean((0, 1))).astype(np.float32), (2, 2, 1))
