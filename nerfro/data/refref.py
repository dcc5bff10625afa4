"""The RefRef benchmark, as its parquet files come from its host."""

from __future__ import annotations

import functools
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfro.allowed import Distance, Factor
from nerfro.data.base import Frame, Views
from nerfro.data.frames import SPLITS, Lens, PosedImages, check_pose
from nerfro.data.image_files import Alpha
from nerfro.data.transforms import parse_matrix
from nerfro.errors import NerfroError
from nerfro.registry import register

# Constants of RefRef's refref_dataparser.py: horizontal field of view, half side of the scene's box, views of a split.
_CAMERA_ANGLE_X = 1.1656107902526855
_HALF_SIDE = 7.3
_VIEWS_PER_SPLIT = 100

_COLUMNS = ["image", "mask", "transform_matrix"]


@register("data", "refref")
class RefRefData(PosedImages):
    """A scene of RefRef: rows of image, mask and pose (OpenGL axes), a hundred each for train, val and test.

    Args:
        root: folder with the scene's .parquet files, at any depth.
        scene: its name, such as cube_smcvx_ampoule; none where the folder holds one scene alone.
        near, far, downscale, alpha: see `PosedImages`; `far` none takes, from the farthest camera of all splits, the
            farthest corner of RefRef's box of side 14.6.
    """

    def __init__(
        self,
        root: str,
        scene: str | None = None,
        near: Distance = 0.2,
        far: Distance | None = None,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
    ) -> None:
        super().__init__(root, near, far, downscale, alpha)
        self.scene = scene

    def load(self, split: str) -> Views:
        self.require(split)
        files = self._files()
        first = SPLITS.index(split) * _VIEWS_PER_SPLIT
        rows = _read_rows(files, range(first, first + _VIEWS_PER_SPLIT), _COLUMNS)
        farthest = _find_far(files) if self.far is None else 0.0
        folder = Path(tempfile.mkdtemp(dir=_unpacked().name))
        frames = [_unpack(row, number, folder, files[0]) for number, row in rows]
        lens = functools.partial(Lens.of_angle, _CAMERA_ANGLE_X)
        views = self.views(frames, lambda w, h: [lens(w, h)] * len(frames), "opengl", farthest=farthest)
        return replace(views, frames=())  # their files go with this process

    def _files(self) -> list[Path]:
        """The scene's files in order."""
        pattern = "*.parquet" if self.scene is None else f"{self.scene}-*.parquet"
        files = sorted(self.root.rglob(pattern)) or sorted(self.root.rglob(f"{self.scene}.parquet"))
        if not files:
            raise NerfroError(f"data.root={self.root} holds no {pattern}; download the scene's files there")
        # `cube_smcvx_ampoule-00000-of-00002.parquet`
        scenes = sorted({path.stem.split("-")[0] for path in files})
        if len(scenes) > 1:
            raise NerfroError(f"data.root={self.root} holds several scenes; choose data.scene={', '.join(scenes[:5])}")
        return files


@functools.cache
def _unpacked() -> tempfile.TemporaryDirectory[str]:
    """Where pictures are unpacked, for as long as this process runs."""
    return tempfile.TemporaryDirectory(prefix="nerfro_refref_")


def _find_far(files: list[Path]) -> float:
    """The default far bound, one for all splits."""
    rows = _read_rows(files, range(len(SPLITS) * _VIEWS_PER_SPLIT), ["transform_matrix"])
    distance = max(float(np.linalg.norm(_pose(row, f"{files[0].name}: row {number}")[:, 3])) for number, row in rows)
    return distance + math.sqrt(3) * _HALF_SIDE


def _read_rows(files: list[Path], numbers: range, columns: list[str]) -> list[tuple[int, dict[str, Any]]]:
    """Number and content of the rows of a range, as far as there are any."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise NerfroError(
            "data=refref reads .parquet files with pyarrow; install it: pip install nerfro[refref]"
        ) from error
    rows: list[tuple[int, dict[str, Any]]] = []
    offset = 0
    for path in files:
        try:
            table = pyarrow.parquet.ParquetFile(path)
            num_rows = table.metadata.num_rows
            wanted = range(max(numbers.start, offset), min(numbers.stop, offset + num_rows))
            if len(wanted):
                missing = [name for name in columns if name not in table.schema_arrow.names]
                if missing:
                    raise NerfroError(f"{path} has no column '{missing[0]}'; is it a file of RefRef?")
                part = table.read(columns).slice(wanted.start - offset, len(wanted))
                rows += zip(wanted, part.to_pylist(), strict=True)
        except (pyarrow.ArrowException, OSError) as error:
            reason = str(error).split("\n")[0]
            raise NerfroError(f"{path} cannot be read ({reason}); download it again") from error
        offset += num_rows
    if not rows:
        raise NerfroError(
            f"{files[0].parent} holds {offset} rows, none from {numbers.start} on; is a file of the scene missing?"
        )
    return rows


def _unpack(row: dict[str, Any], number: int, folder: Path, source: Path) -> Frame:
    """Write a row's pictures where the common reader finds them."""
    where = f"{source.name}: row {number}"
    paths = []
    for column in ("image", "mask"):
        content = (row[column] or {}).get("bytes")
        if content is None:
            raise NerfroError(f"{where}: '{column}' holds no picture; download the file again")
        paths.append(folder / f"{column}_{number:04d}.png")
        paths[-1].write_bytes(content)
    return Frame(paths[0].name, paths[0], paths[1], _pose(row, where))


def _pose(row: dict[str, Any], where: str) -> Float[np.ndarray, "3 4"]:
    return check_pose(parse_matrix(row["transform_matrix"], ((4, 4), (3, 4)), f"{where}: transform_matrix"), where)
