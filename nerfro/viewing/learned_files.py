"""What a run has learned of cameras and surface, as files for other programs."""

from __future__ import annotations

from pathlib import Path

from nerfro.data.base import Views
from nerfro.models.base import NerfModel
from nerfro.viewing.camera_files import write_cameras
from nerfro.viewing.surface import surface_of


def write_learned(folder: Path, model: NerfModel, training: Views) -> None:
    """Write cameras.json where the training cameras were refined, and surface.ply where the surface was."""
    write_cameras(folder / "cameras.json", model.camera, training)
    if model.medium.surface_parameters():
        surface_of(model.medium, triangles=False)[0].save(folder / "surface.ply")
