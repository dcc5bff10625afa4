"""Data format of the RefRef benchmark: parquet files."""

from __future__ import annotations

import functools
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError, optional
from nerfro.data.base import SPLITS, Frame, Views
from nerfro.data.frames import FrameSet, PosedImages, check_pose
from nerfro.data.image_files import read_size
from nerfro.data.lenses import Lens
from nerfro.files.reading import parse_matrix, reading
from nerfro.registry.allowed import Distance
from nerfro.registry.registration import register

# Views per split, field of view and half side of the scene box as in RefRef's refref_dataparser.py.
_VIEWS_PER_SPLIT = 100

_COLUMNS = ["image", "mask", "transform_matrix"]


@register("data", "refref")
class RefRefData(PosedImages):
    """Read a scene of RefRef: rows of image, mask and pose, a hundred rows each for train, val and test.

    Poses have OpenGL camera axes.

    Args:
        root: folder that contains the .parquet files of the scene at any depth.
        scene: name of the scene, such as cube_smcvx_ampoule. It may be omitted if the folder holds one scene.
        far: arc length at which rays end; by default the greatest distance between any camera and any corner of
            RefRef's scene box, whose side is 14.6.
        options: see `PosedImages`.
    """

    def __init__(self, root: str, scene: str | None = None, near: Distance = 0.2, **options: Any) -> None:
        super().__init__(root, near, **options)
        self.scene = scene

    def load(self, split: str) -> Views:
        return replace(super().load(split), frames=())  # the unpacked files exist only while this process runs

    def read(self, split: str) -> FrameSet:
        files = self._files()
        first = SPLITS.index(split) * _VIEWS_PER_SPLIT
        rows = _read_rows(files, range(first, first + _VIEWS_PER_SPLIT), _COLUMNS)
        farthest = _find_far(files) if self.far is None else 0.0
        folder = Path(tempfile.mkdtemp(dir=_unpacked().name))
        frames = [_unpack(row, number, folder, files[0]) for number, row in rows]
        width, height, _ = read_size(frames[0].image)
        lenses = [Lens.of_angle(1.1656107902526855, width, height)] * len(frames)
        return FrameSet(frames, lenses, "opengl", far=farthest)

    def _files(self) -> list[Path]:
        """List the files of the scene in order."""
        scene, files = self.scene, sorted(self.root.rglob("*.parquet"))
        if scene is not None:
            files = [path for path in files if path.stem == scene or path.stem.startswith(f"{scene}-")]
        if not files:
            pattern = "*.parquet" if scene is None else f"{scene}-*.parquet"
            raise NerfroError(f"data.root={self.root} holds no {pattern}; download the scene's files there")
        # `cube_smcvx_ampoule-00000-of-00002.parquet`
        scenes = sorted({path.stem.split("-")[0] for path in files})
        if len(scenes) > 1:
            raise NerfroError(f"data.root={self.root} holds several scenes; choose data.scene={', '.join(scenes[:5])}")
        return files


@functools.cache
def _unpacked() -> tempfile.TemporaryDirectory[str]:
    """Return the folder for unpacked images, which is deleted when the process ends."""
    return tempfile.TemporaryDirectory(prefix="nerfro_refref_")


def _find_far(files: list[Path]) -> float:
    """Compute the default far bound, which is the same for all splits."""
    rows = _read_rows(files, range(len(SPLITS) * _VIEWS_PER_SPLIT), ["transform_matrix"])
    distance = max(float(np.linalg.norm(_pose(row, f"{files[0].name}: row {number}")[:, 3])) for number, row in rows)
    return distance + math.sqrt(3) * 7.3


def _read_rows(files: list[Path], numbers: range, columns: list[str]) -> list[tuple[int, dict[str, Any]]]:
    """Read the existing rows of a range.

    Returns:
        Number and content of each row.
    """
    parquet = optional("pyarrow.parquet", "refref", "data=refref reads .parquet files with pyarrow")
    rows: list[tuple[int, dict[str, Any]]] = []
    offset = 0
    for path in files:
        with reading(path, advice="download it again"):
            table = parquet.ParquetFile(path)
            num_rows = table.metadata.num_rows
            wanted = range(max(numbers.start, offset), min(numbers.stop, offset + num_rows))
            if len(wanted):
                missing = [name for name in columns if name not in table.schema_arrow.names]
                if missing:
                    raise NerfroError(
                        f"{path} has no column '{missing[0]}', so it is not a file of RefRef; correct data.root"
                    )
                part = table.read(columns).slice(wanted.start - offset, len(wanted))
                rows += zip(wanted, part.to_pylist(), strict=True)
        offset += num_rows
    if not rows:
        raise NerfroError(
            f"{files[0].parent} holds {offset} rows, none from {numbers.start} on; download the missing files"
        )
    return rows


def _unpack(row: dict[str, Any], number: int, folder: Path, source: Path) -> Frame:
    """Write the image and mask of a row to PNG files, and return the frame."""
    where = f"{source.name}: row {number}"
    paths = []
    for column in ("image", "mask"):
        content = row[column].get("bytes") if isinstance(row[column], dict) else None
        if not isinstance(content, bytes):
            raise NerfroError(f"{where}: '{column}' holds no image; download the file again")
        paths.append(folder / f"{column}_{number:04d}.png")
        paths[-1].write_bytes(content)
    return Frame(paths[0].name, paths[0], paths[1], _pose(row, where))


def _pose(row: dict[str, Any], where: str) -> Float[np.ndarray, "3 4"]:
    return check_pose(parse_matrix(row["transform_matrix"], ((4, 4), (3, 4)), f"{where}: transform_matrix"), where)
