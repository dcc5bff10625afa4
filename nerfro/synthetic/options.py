"""Options of `nerfro.synthesize`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Le

from nerfro.registry.allowed import Count, Names, Natural, NotNegative, Positive
from nerfro.synthetic.scenes import SCENES

SceneName = Annotated[str, Names(lambda: SCENES)]


@dataclass
class ViewCounts:
    """Number of views per split.

    Attributes:
        train, val, test: number of training, validation and test views.
    """

    train: Count = 100
    val: Count = 100
    test: Count = 200


@dataclass
class SynthesizeConfig:
    """Options of `nerfro.synthesize`.

    Attributes:
        scene: scene to render, or a glTF file (.glb, .gltf) whose refractive materials become bodies; dolphin_capture
            makes photographs without poses.
        out: folder of the data set; by default outputs/scenes/SCENE.
        resolution: side of the square images, pixels; width of photographs, which are 4:3.
        spp: samples per pixel of training and validation views.
        test_spp: samples per pixel of test views; noise of the reference limits every score.
        photographs: number of photographs of dolphin_capture, instead of views.
        noise: standard deviation of the sensor noise of dolphin_capture, for values in [0, 1].
        fresnel: whether the glass reflects a part of the light.
        absorption: absorption of the glass for red, green and blue, per world unit.
        ior: refractive index of the glass; by default that of the scene.
        seed: seed of viewpoints and sampler.
        sky: lat-long image of the surroundings (.hdr, .exr, .png, .jpg), in place of those of the scene.
        cameras: poses: an orbit on all sides of the object, the upper half of the orbit, a ring at 25 degrees above the
            horizon, or for a glTF file those of the file.
        turntable: whether the object turns before the camera, and the surroundings stand still. In a ring, the camera
            stands still, too; otherwise it also moves up and down.
        format: format of the images: png (8-bit sRGB, clipped), or exr (linear radiance).
        sky_height: rows of sky.png.
        extras: whether to write interior.ply and sky.exr, which training does not need.
        variant: variant of Mitsuba: auto, llvm_ad_rgb, cuda_ad_rgb or scalar_rgb.
        overwrite: whether a data set with other settings in `out` may be replaced.
    """

    scene: SceneName = "torus"
    out: str | None = None
    resolution: Annotated[int, Ge(8), Le(16384)] = 800
    spp: Count = 256
    test_spp: Count = 1024
    views: ViewCounts = field(default_factory=ViewCounts)
    photographs: Count = 72
    noise: NotNegative = 0.01
    fresnel: bool = False
    absorption: list[NotNegative] = field(default_factory=lambda: [0.0] * 3)
    ior: Positive | None = None
    seed: Natural = 0
    sky: str | None = None
    cameras: Literal["orbit", "above", "ring", "file"] = "orbit"
    turntable: bool = False
    format: Literal["png", "exr"] = "png"
    sky_height: Annotated[int, Ge(16), Le(16384)] = 1024
    extras: bool = True
    variant: str = "auto"
    overwrite: bool = False
