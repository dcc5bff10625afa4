"""Options of `nerfro.mask`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import Ge, Le
from omegaconf import MISSING


@dataclass
class MaskConfig:
    """Options of `python -m nerfro.mask`.

    Attributes:
        data: data set (options of the group `data`); the views of all splits get masks.
        outlines: by image name, a box [left, top, right, bottom] around the object, or a polygon [[column, row], ...],
            which is the mask, in pixels; or a JSON file with such a mapping.
        sam2: folder of a Segment Anything 2 network in the format of transformers, which follows the object from the
            outlines and existing masks through the photographs in the order of their names; needs the extra `sam2`.
        hull_only: project the visual hull of at least three existing masks into all other views, without segmentation
            by colour.
        overwrite: replace existing masks, starting from the outlines alone. Otherwise existing masks are kept and used,
            except projections of a hull, which are made again.
        view: serve a page on which you draw outlines in two to five views and see the projections of the hull in all
            others; saving writes `outlines.json` to the data folder, and the masks.
        host: address of the server of this page; 0.0.0.0 accepts connections from other machines.
        port: port of the server; 0 for any free port.
        open: open a browser.
    """

    data: Any = MISSING
    outlines: Any = None
    sam2: str | None = None
    hull_only: bool = False
    overwrite: bool = False
    view: bool = False
    host: str = "localhost"
    port: Annotated[int, Ge(0), Le(65535)] = 8008
    open: bool = True
