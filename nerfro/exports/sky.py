"""Export of the background radiance as a latitude-longitude image."""

from __future__ import annotations

from pathlib import Path

from nerfro.files.lat_long import save_lat_long
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene


def write_sky(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write the background radiance; `options.resolution` is the number of rows."""
    sky = scene.sky_of_height(options.resolution or scene.sky_height)
    save_lat_long(out, sky)
    turntable = scene.cameras("train").turntable
    frame = ", in the room of the turntable, where the camera looks towards -x" if turntable else ""
    return f"the sky: {sky.shape[1]}x{sky.shape[0]} pixels, lat-long, z up{frame}"


EXPORTS["sky"] = Export((".hdr", ".exr", ".png"), write_sky, uses=("resolution", "sky"))
