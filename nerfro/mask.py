"""`python -m nerfro.mask data=... data.root=DIR outlines={NAME:BOX}`: segment the object in all views."""

from __future__ import annotations

import shlex

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from nerfro.capture.mask_files import (
    MaskConfig,
    check_start,
    find_frame,
    load_all,
    mask_sheet,
    read_outlines,
    read_resized,
    report_masks,
    save_mask,
)
from nerfro.capture.masking import box_region, grab, polygon_mask, propagate
from nerfro.capture.opencv import opencv
from nerfro.capture.overrides import is_given, of_groups
from nerfro.cli import entry_point
from nerfro.data.image_files import read_size
from nerfro.errors import NerfroError
from nerfro.files.images import save_image
from nerfro.paths import EMBEDDED_PREFIX
from nerfro.registry import build

_SHEET = "masks.png"


@entry_point("mask", MaskConfig)
@torch.no_grad()
def main(config: DictConfig) -> None:
    """Segment the outlined views, then all other views, and write the missing masks."""
    if str(config.data.root).startswith(EMBEDDED_PREFIX):
        raise NerfroError(f"data.root={config.data.root} is part of nerfro and has masks; set data.root to your folder")
    outlines = read_outlines(config.outlines)
    source = build(config.data)
    cameras, images, frames = load_all(source)
    outlined = {find_frame(name, frames): outline for name, outline in outlines.items()}
    kept = {} if config.overwrite else {i: frame.mask for i, frame in enumerate(frames) if frame.mask is not None}
    check_start(frames, outlined, kept, config.hull_only)
    opencv()  # report a missing package before the long work starts
    size = cameras.width, cameras.height
    done = {view: read_resized(mask, size, source.mask_labels) for view, mask in kept.items()}
    for view, outline in outlined.items():
        scaled = np.array(outline, np.float64) * size[0] / read_size(frames[view].image)[0]
        if scaled.ndim == 2:  # the user's polygon is the mask
            done[view] = polygon_mask(scaled, size)
        else:
            region = box_region(scaled, size)
            done[view] = grab(images[view], region, region)
    for view, mask in done.items():
        if not mask.any():
            raise NerfroError(f"{frames[view].name}: the outline or mask is empty; draw it around the object")
    missing = len(frames) - len(done)
    print(f"{len(kept)} existing masks, {len(outlined)} outlines; segmenting {missing} further views")
    with tqdm(total=missing, desc="segmenting", unit="view", dynamic_ncols=True) as progress:
        found = propagate(images, cameras, done, config.hull_only, progress.update)
    made = [view for view in range(len(frames)) if view not in kept]
    for view in made:
        save_mask(frames[view], found.masks[view])
    save_image(source.root / _SHEET, mask_sheet(images, frames, found))
    report_masks(frames, found)
    print(f"wrote {len(made)} masks beside their images (mask_*.png); check them in {source.root / _SHEET}")
    print("correct wrong masks in a paint program; or delete them, outline one of these views, and repeat the command")
    given = of_groups(("data",), HydraConfig.get().overrides.task)
    given = given if is_given("data", given) else ["data=opencv", *given]
    print(f"next: {shlex.join(['python', '-m', 'nerfro.preprocess', *given, 'medium.ior=1.33'])}")


if __name__ == "__main__":
    main()
