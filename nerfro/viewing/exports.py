"""Export of a trained scene: options of the command, and a writer for each kind of file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

from annotated_types import Ge
from omegaconf import MISSING

from nerfro.core.errors import NerfroError
from nerfro.registry.allowed import Count, Names, Positive
from nerfro.registry.registration import discover
from nerfro.viewing.trained_scene import TrainedScene

ExportName = Annotated[str, Names(lambda: EXPORTS)]


@dataclass
class ExportConfig:
    """Options of `python -m nerfro.export`.

    Attributes:
        checkpoint: run folder, or a checkpoint in it.
        what: content and kind of the file.
        out: output file, whose ending selects the format, or the folder of cameras and colmap.
        resolution: grid vertices along the longest side of the volume (default 128), or rows of the sky (by
            default as many as the background has, at least 512), or the longest side of the images that Gaussians are
            fitted to (by default at most 256 pixels).
        half_depth: length, world units, within which dense content absorbs half the light; the surface is
            extracted at this density. By default a hundredth of the object's longest side.
        triangles: largest number of triangles of a mesh, of which the glass has at most half. By default 20000 in a
            .glb or .usdz, and as many as the surfaces have in .ply and .obj.
        gaussians: number of Gaussians of splats.
        steps: steps of gradient descent that fit Gaussians.
        sky: lat-long image that replaces the sky (.hdr, .exr, .png, .jpg).
        root: folder of the data, if it has moved since training.
        device: `cpu` or `cuda`; `auto` means the CPU.
        overwrite: whether existing output files may be replaced.
    """

    checkpoint: str = MISSING
    what: ExportName = MISSING
    out: str = MISSING
    resolution: Count | None = None
    half_depth: Positive | None = None
    triangles: Annotated[int, Ge(100)] | None = None
    gaussians: Annotated[int, Ge(10)] = 50_000
    steps: Count = 500
    sky: str | None = None
    root: str | None = None
    device: str = "auto"
    overwrite: bool = False


@dataclass(frozen=True)
class Export:
    """A format of exported files.

    Attributes:
        suffixes: allowed endings of the file; `("",)` for a folder of files.
        write: writes the file and returns a short description of the content.
        companions: endings of further files; `_sky.hdr` stands for `scene_sky.hdr` beside `scene.xml`.
        uses: options of `ExportConfig` with an effect on the file, beside checkpoint, what, out, root, device and
            overwrite.
    """

    suffixes: tuple[str, ...]
    write: Callable[[TrainedScene, Path, ExportConfig], str]
    companions: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()

    @property
    def is_folder(self) -> bool:
        """Whether `out` is a folder."""
        return self.suffixes == ("",)

    @property
    def unused(self) -> list[str]:
        """Options without effect on the file."""
        used = {"checkpoint", "what", "out", "root", "device", "overwrite", *self.uses}
        return [field.name for field in fields(ExportConfig) if field.name not in used]

    def files(self, out: Path) -> list[Path]:
        """Return all files that `write` may write."""
        return [out, *(out.with_name(out.stem + ending) for ending in self.companions)]


EXPORTS: dict[str, Export] = {}
"""Exports by the name in `what=`; modules that `discover` imports add theirs."""


def find_export(what: str, out: Path) -> Export:
    """Return the export of a name, and check the ending of the output file.

    Raises:
        NerfroError: the name is unknown, or the file has another ending.
    """
    export = export_of(what)
    if out.suffix.lower() not in export.suffixes:
        if export.is_folder:
            raise NerfroError(f"out={out} is not a folder of {what}; it must be a folder, without ending")
        raise NerfroError(f"out={out} is not a file of {what}; it must end in {' or '.join(export.suffixes)}")
    return export


def export_of(what: str) -> Export:
    """Return the export of a name.

    Raises:
        NerfroError: the name is unknown, or a plugin has added another object than an `Export`.
    """
    discover()
    if what not in EXPORTS:
        raise NerfroError(f"what={what} is not known; choose {', '.join(EXPORTS)}")
    export = EXPORTS[what]
    if not isinstance(export, Export):
        raise NerfroError(f"EXPORTS[{what!r}] of a plugin is {export!r}; make it an Export of endings and a function")
    return export
