"""Options of `nerfro.calibrate`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from nerfro.data.frames import Every
from nerfro.registry.allowed import Count, Natural, Positive

LensModel = Literal["pinhole", "radial", "opencv"]
Pairs = Literal["sequential", "all"]
Squares = Annotated[int, Ge(1), Le(100)]  # along a side of a board


@dataclass
class CalibrateConfig:
    """Options of `python -m nerfro.calibrate`.

    Attributes:
        images: folder of the photographs, all with one lens and size; the folder may also contain masks (`mask_*`).
        out: output folder for transforms_{train,val,test}.json, calibration.json and cameras.png.
        target: `apriltag` for a board of AprilTags in the scene, or `colmap` for structure from motion.
        board: layout of the tags: `twelve_faces` (the paper's board, of tagStandard41h12) or `grid`, one sheet of
            tag36h11.
        columns, rows: number of tags of a grid; by default 5 and 7.
        size: side of a tag between its detected corners (in a grid: up to the outer borders), in the unit of the poses;
            metres for printing.
        write_board: write the board for printing, board.pdf and board_*.png, to `out`. Without `images` the command
            ends there.
        reconstruction: folder of a COLMAP model; by default the largest model in sparse/ or colmap/sparse/ beside
            `images`, in the folder of `images`, or within `images`, else a new model.
        pairs: image pairs that COLMAP matches: `sequential` (each image with the ten next ones, and with fewer distant
            ones) or `all`; by default sequential if the file names are numbered.
        threads: number of threads of COLMAP; by default one per core.
        lens: distortion coefficients to estimate beside focal lengths and principal point: `pinhole` none, as in the
            paper; `radial` k1 and k2; `opencv` k1, k2, p1 and p2.
        mask_labels: labels of the object in the masks, as `data.mask_labels`; by default all but the background.
        test_every: every such image by name is a test image, and as many are validation images.
        overwrite: allow replacing existing files.
    """

    images: str | None = None
    out: str | None = None
    target: Literal["apriltag", "colmap"] = "apriltag"
    board: Literal["twelve_faces", "grid"] = "twelve_faces"
    columns: Squares | None = None
    rows: Squares | None = None
    size: Positive = 0.05
    write_board: bool = False
    reconstruction: str | None = None
    pairs: Pairs | None = None
    threads: Count | None = None
    lens: LensModel = "pinhole"
    mask_labels: list[Natural] | None = None
    test_every: Every = 8
    overwrite: bool = False
