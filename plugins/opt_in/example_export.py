"""Template: an export of your own in one file. Use it with `python -m nerfro.export what=cameras out=FILE.csv`.

The file is used only if the environment variable `NERFRO_PLUGINS` names its folder, or if you copy it to `plugins/`,
because importing the exports takes time.
"""

from __future__ import annotations

from pathlib import Path

from nerfro.files.atomic import write_atomically
from nerfro.viewing import PLUGIN_EXPORTS
from nerfro.viewing.exports import Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene


def write_centres(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write the centres of the training cameras, in world units, and return a description of the file."""
    centres = scene.cameras("train").camera_to_world[:, :, 3].tolist()
    write_atomically(out, "x,y,z\n" + "".join(",".join(map(str, centre)) + "\n" for centre in centres))
    return f"the centres of {len(centres)} cameras"


PLUGIN_EXPORTS["cameras"] = __name__  # `what=cameras`; the command looks for EXPORT in this module
EXPORT = Export((".csv",), write_centres)
