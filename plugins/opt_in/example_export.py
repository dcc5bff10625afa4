"""Template: an export of your own in one file. Use it with `python -m nerfro.export what=camera_centres out=FILE.csv`.

The file is used only if the environment variable `NERFRO_PLUGINS` names its folder, or if you copy it to `plugins/`,
because importing the exports takes time.
"""

from __future__ import annotations

from pathlib import Path

from nerfro.parts import EXPORTS, Export, ExportConfig, TrainedScene, write_atomically


def write_centres(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write the centres of the training cameras, in world units, and return a description of the file."""
    centres = scene.cameras("train").camera_to_world[:, :, 3].tolist()
    write_atomically(out, "x,y,z\n" + "".join(",".join(map(str, centre)) + "\n" for centre in centres))
    return f"the centres of {len(centres)} cameras"


EXPORTS["camera_centres"] = Export((".csv",), write_centres)
