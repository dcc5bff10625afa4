"""Masks of the object: from the options of `nerfro.mask` to the files."""

from __future__ import annotations

import json
from collections.abc import Sequence

import torch
from omegaconf import DictConfig

from nerfro.cli.calls import Composition, composed
from nerfro.cli.overrides import as_overrides
from nerfro.core.errors import NerfroError
from nerfro.core.paths import EMBEDDED_PREFIX
from nerfro.core.progress import progress_bar
from nerfro.data.base import DataSource
from nerfro.data.capture import Capture
from nerfro.data.frames import require_root
from nerfro.files.atomic import lock_folder, write_atomically
from nerfro.masks.mask_files import MaskTask, read_outlines
from nerfro.masks.masking import Segmentation
from nerfro.masks.options import MaskConfig
from nerfro.masks.outline_page import OutlinePage
from nerfro.registry.registration import build
from nerfro.rendering.scene_file import with_scene

_OUTLINES = "outlines.json"


def segment(capture: Capture, overrides: Sequence[str] = (), **settings: object) -> Capture:
    """Segment the object in all photographs of a capture, and write the missing masks.

    Args:
        capture: photographs with poses, and possibly some masks.
        overrides: settings as on the command line of `python -m nerfro.mask`.
        **settings: options by name, as in `segment(capture, outlines={"img_01.jpg": [120, 80, 400, 460]})`.

    Returns:
        The capture, with masks.

    Raises:
        NerfroError: the data set is part of nerfro, there is nothing to start from, or the views disagree.
    """
    arguments = [*capture.overrides, *as_overrides(settings), *overrides]
    with composed("mask", MaskConfig, arguments, with_scene) as composition:
        return segment_composed(composition)


@torch.no_grad()
def segment_composed(composition: Composition) -> Capture:
    """Write the missing masks for composed options, see `segment`."""
    config = composition.config
    if str(config.data.root).startswith(EMBEDDED_PREFIX):
        raise NerfroError(f"data.root={config.data.root} is part of nerfro and has masks; set data.root to your folder")
    source = build(config.data)
    require_root(source.root)
    with lock_folder(source.root, "data.root"):
        _mask(config, source)
    return Capture.of(composition)


def _mask(config: DictConfig, source: DataSource) -> None:
    drawn = source.root / _OUTLINES
    continues = config.view and config.outlines is None and drawn.is_file()
    outlines = read_outlines(str(drawn) if continues else config.outlines)
    task = MaskTask.load(source, config, outlines)
    if config.view:

        def save(outlines: dict[str, list], segmentation: Segmentation) -> str:
            write_atomically(drawn, json.dumps(outlines) + "\n")
            return f"{task.save(outlines, segmentation)}; the outlines are in {drawn}"

        page = OutlinePage(task.images, task.frames, outlines, task.segment, save)
        page.serve(source.root.name, config.host, config.port, config.open)
    else:
        missing = len(task.frames) - len(task.kept) - len(outlines)
        print(f"{len(task.kept)} existing masks, {len(outlines)} outlines; segmenting {missing} further views")
        with progress_bar("segmenting", missing) as progress:
            segmentation = task.segment(outlines, progress.update)
        print(task.save(outlines, segmentation))
        print("correct wrong masks in a paint program; or delete them, outline one of these views, and repeat")
