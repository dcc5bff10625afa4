"""What a trained scene can be written as, and for which options it asks."""

# ruff: noqa: UP045 - OmegaConf on Python 3.10 wants Optional

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Optional

from omegaconf import MISSING, DictConfig

from nerfro.allowed import Count, Positive
from nerfro.errors import NerfroError
from nerfro.view.scene import Scene


@dataclass
class ExportConfig:
    """What `python -m nerfro.export` is asked."""

    checkpoint: str = MISSING  # run folder, or a checkpoint in it
    what: str = MISSING  # one of `EXPORTS`
    out: str = MISSING  # file that is written
    # Grid vertices a side of the inside, or rows of the sky; by default as fine as the model.
    resolution: Optional[Count] = None
    # Optical depth along one cell from which the inside counts as solid, for meshes and points.
    level: Positive = 0.5
    sky: Optional[str] = None  # lat-long picture that replaces the sky (.hdr, .exr, .png, .jpg)
    root: Optional[str] = None  # folder of the data, if it has moved since training
    device: str = "auto"  # `cpu`, `cuda`, or `auto` for a GPU if there is one
    overwrite: bool = False  # whether `out` may be replaced


@dataclass(frozen=True)
class Export:
    """One kind of file."""

    suffixes: tuple[str, ...]  # of the file's name
    write: Callable[[Scene, Path, DictConfig], str]  # writes the file and says in a few words what it holds

    def check_name(self, out: Path) -> None:
        """Refuse a name that is not that of such a file."""
        if out.suffix.lower() not in self.suffixes:
            raise NerfroError(f"out={out} must end in {' or '.join(self.suffixes)}, for that is what is written")


def _sky(scene: Scene, out: Path, config: DictConfig) -> str:
    from nerfro.files.lat_long import save_lat_long
    from nerfro.view.scene import SKY_HEIGHT

    sky = scene.sky_of_height(config.resolution or SKY_HEIGHT)
    save_lat_long(out, sky)
    return f"the sky, {sky.shape[1]}x{sky.shape[0]} pixels of linear radiance"


EXPORTS = {"sky": Export((".hdr", ".exr", ".png"), _sky)}
