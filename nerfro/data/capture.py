"""Photographs with poses, which the stages from photographs to a trained scene exchange."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from nerfro.cli.calls import Composition
from nerfro.cli.overrides import as_overrides
from nerfro.core.paths import resolve_path

_MASKS = ("masks/*", "masks/*/*", "mask_*", "*/mask_*")  # where the data formats search for masks


@dataclass(frozen=True)
class Capture:
    """Photographs with poses in a folder, and masks of the object, if there are any.

    Attributes:
        root: folder of the photographs, or an embedded scene such as `embedded:torus`.
        data: format of the folder, an option of the group `data` such as `opencv` or `blender`.
        settings: settings of the format, such as `{"mask_labels": [1]}`.
    """

    root: str | Path
    data: str = "opencv"
    settings: Mapping[str, object] = field(default_factory=dict)

    @classmethod
    def of(cls, composition: Composition) -> Capture:
        """Return the capture that the group `data` of a configuration describes."""
        settings = composition.described("data")
        settings.pop("root", None)  # absent for the default
        return cls(str(composition.config.data.root), settings.pop("type"), settings)

    @property
    def overrides(self) -> list[str]:
        """The capture as overrides of a command."""
        settings = {f"data.{name}": value for name, value in self.settings.items()}
        return as_overrides({"data": self.data, "data.root": self.root, **settings})

    @property
    def masks(self) -> list[Path]:
        """Files of the masks."""
        return [file for pattern in _MASKS for file in resolve_path(self.root).glob(pattern)]
