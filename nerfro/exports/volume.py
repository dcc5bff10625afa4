"""Export of the radiance field as arrays on a regular grid."""

from __future__ import annotations

from pathlib import Path

from nerfro.files.cache import save_arrays
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import RESOLUTION, sample_field


def write_volume(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write density, linear radiance and the corners of the grid as .npz."""
    volume = sample_field(scene, options.resolution or RESOLUTION)
    arrays = {"density": volume.density, "rgb": volume.radiance, "box": volume.space.box}
    save_arrays(out, {name: values.numpy() for name, values in arrays.items()})
    return f"the inside: {'x'.join(map(str, volume.density.shape))} vertices with density and linear rgb"


EXPORTS["volume"] = Export((".npz",), write_volume, uses=("resolution",))
