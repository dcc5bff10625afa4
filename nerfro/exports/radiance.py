"""Exports of radiance: the background as a latitude-longitude image, and the field as arrays on a regular grid."""

from __future__ import annotations

from pathlib import Path

from nerfro.files.cache import save_arrays
from nerfro.files.lat_long import save_lat_long
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import RESOLUTION, sample_field


def write_sky(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write the background radiance; `options.resolution` is the number of rows."""
    sky = scene.sky_of_height(options.resolution or scene.sky_height)
    save_lat_long(out, sky)
    turntable = scene.cameras("train").turntable
    frame = ", in the room of the turntable, where the camera looks towards -x" if turntable else ""
    return f"the sky: {sky.shape[1]}x{sky.shape[0]} pixels, lat-long, z up{frame}"


EXPORTS["sky"] = Export((".hdr", ".exr", ".png"), write_sky, uses=("resolution", "sky"))


def write_volume(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write density, linear radiance and the corners of the grid as .npz."""
    volume = sample_field(scene, options.resolution or RESOLUTION)
    arrays = {"density": volume.density, "rgb": volume.radiance, "box": volume.space.box}
    save_arrays(out, {name: values.numpy() for name, values in arrays.items()})
    return f"the inside: {'x'.join(map(str, volume.density.shape))} vertices with density and linear rgb"


EXPORTS["volume"] = Export((".npz",), write_volume, uses=("resolution",))
