"""`python -m nerfro.mask data=... data.root=DIR outlines={NAME:BOX}`: segment the object in all views.

Examples:
    nerfro mask data.root=data/glass 'outlines={img_01.jpg: [120, 80, 400, 460]}'
    nerfro mask data=colmap data.root=data/glass view=true
"""

from __future__ import annotations

import json

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

import nerfro.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli import entry_point
from nerfro.data.base import DataSource
from nerfro.data.frames import require_root
from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.folder_lock import lock_folder
from nerfro.masks.mask_files import MaskConfig, MaskTask, read_outlines
from nerfro.masks.masking import Segmentation
from nerfro.overrides import is_given, of_groups, print_next
from nerfro.paths import EMBEDDED_PREFIX
from nerfro.progress import progress_bar
from nerfro.registry import build
from nerfro.rendering.scene_file import with_scene
from nerfro.viewing.outline_page import OutlinePage

_OUTLINES = "outlines.json"


@entry_point("mask", MaskConfig, expand=with_scene)
@torch.no_grad()
def main(config: DictConfig) -> None:
    """Segment the outlined views, then all other views, and write the missing masks."""
    if str(config.data.root).startswith(EMBEDDED_PREFIX):
        raise NerfroError(f"data.root={config.data.root} is part of nerfro and has masks; set data.root to your folder")
    source = build(config.data)
    require_root(source.root)
    with lock_folder(source.root, "data.root"):
        _mask(config, source)
    given = of_groups(("data",), HydraConfig.get().overrides.task)
    given = given if is_given("data", given) else ["data=opencv", *given]
    print_next("next", "preprocess", [*given, "medium.ior=1.33"])


def _mask(config: DictConfig, source: DataSource) -> None:
    drawn = source.root / _OUTLINES
    continues = config.view and config.outlines is None and drawn.is_file()
    outlines = read_outlines(str(drawn) if continues else config.outlines)
    task = MaskTask.load(source, config, outlines)
    if config.view:

        def save(outlines: dict[str, list], found: Segmentation) -> str:
            write_atomically(drawn, json.dumps(outlines) + "\n")
            return f"{task.save(outlines, found)}; the outlines are in {drawn}"

        page = OutlinePage(task.images, task.frames, outlines, task.segment, save)
        page.serve(source.root.name, config.host, config.port, config.open)
    else:
        missing = len(task.frames) - len(task.kept) - len(outlines)
        print(f"{len(task.kept)} existing masks, {len(outlines)} outlines; segmenting {missing} further views")
        with progress_bar("segmenting", missing) as progress:
            found = task.segment(outlines, progress.update)
        print(task.save(outlines, found))
        print("correct wrong masks in a paint program; or delete them, outline one of these views, and repeat")


if __name__ == "__main__":
    main()
