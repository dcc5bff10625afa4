"""`python -m nerfro.mask data=... data.root=DIR outlines={NAME:BOX}`: masks of the object where none exist."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from nerfro.capture.mask_files import (
    MaskConfig,
    check_start,
    find_frame,
    load_all,
    mask_sheet,
    read_outlines,
    read_resized,
    save_mask,
    stored_size,
)
from nerfro.capture.masking import grab, outline_region, propagate
from nerfro.capture.targets import opencv
from nerfro.cli import entry_point, warn
from nerfro.data.base import Frame
from nerfro.errors import NerfroError, first_of
from nerfro.files.images import save_picture
from nerfro.paths import EMBEDDED_PREFIX
from nerfro.registry import build

_SHEET = "masks.png"
# The hull is coarse and a little too large; a mask that overlaps this much less with it than is usual is pointed out.
_DOUBTFUL = 0.9


@entry_point("mask", MaskConfig)
@torch.no_grad()
def main(config: DictConfig) -> None:
    """Cut the object out where an outline is given, then in all other views, and write what was missing."""
    if str(config.data.root).startswith(EMBEDDED_PREFIX):
        raise NerfroError(f"data.root={config.data.root} ships with nerfro and has its masks; give a folder of yours")
    outlines = read_outlines(config.outlines)
    source = build(config.data)
    cameras, images, frames = load_all(source)
    outlined = {find_frame(name, frames): outline for name, outline in outlines.items()}
    kept = {} if config.overwrite else {i: frame.mask for i, frame in enumerate(frames) if frame.mask is not None}
    check_start(frames, outlined, kept)
    opencv()  # told now, if it is missing, and not after the hull
    size = cameras.width, cameras.height
    done = {view: read_resized(mask, size) for view, mask in kept.items()}
    for view, outline in outlined.items():
        scaled = np.array(outline, np.float64) * size[0] / stored_size(frames[view])[0]
        done[view] = grab(images[view], *outline_region(scaled, size))
    for view, mask in done.items():
        if not mask.any():
            raise NerfroError(f"{frames[view].name}: nothing is in the outline or the mask; draw it around the object")
    missing = len(frames) - len(done)
    print(f"{len(kept)} masks exist, {len(outlined)} outlines are given; {missing} views are cut out by the hull")
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()) as progress:
        task = progress.add_task("cutting out", total=2 * missing)
        masks, overlaps = propagate(images, cameras, done, lambda count: progress.update(task, completed=count))
    made = [view for view in range(len(frames)) if view not in kept]
    for view in made:
        save_mask(frames[view], masks[view])
    save_picture(source.root / _SHEET, mask_sheet(images, frames, masks, overlaps))
    _report(frames, overlaps, made, source.root / _SHEET)
    given = [text for text in HydraConfig.get().overrides.task if text.startswith(("data=", "data."))]
    if not any(text.startswith("data=") for text in given):
        given = ["data=opencv", *given]
    print(f"next: {shlex.join(['python', '-m', 'nerfro.preprocess', *given, 'medium.ior=1.33'])}")


def _report(frames: list[Frame], overlaps: Mapping[int, float], made: list[int], sheet: Path) -> None:
    print("overlap (intersection over union) of each mask with the hull of the others:")
    worst_first = sorted(overlaps, key=lambda view: overlaps[view])
    for view in worst_first:
        print(f"  {overlaps[view]:.4f}  {frames[view].name}")
    limit = _DOUBTFUL * float(np.median(list(overlaps.values()) or [0.0]))
    bad = [frames[view].name for view in worst_first if overlaps[view] < limit]
    if bad:
        warn(f"overlap much less than is usual: {first_of(bad)}; look at them first")
    print(f"wrote {len(made)} masks beside their images (mask_*.png), and {sheet}: look at it")
    print("correct wrong masks in any paint program, or delete them, outline one of them, and run this again")


if __name__ == "__main__":
    main()
