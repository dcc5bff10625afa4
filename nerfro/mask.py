"""`python -m nerfro.mask data=... data.root=DIR outlines={NAME:BOX}`: segment the object in all views.

Examples:
    nerfro mask data.root=data/glass 'outlines={img_01.jpg: [120, 80, 400, 460]}'
    nerfro mask data=colmap data.root=data/glass view=true
"""

from __future__ import annotations

from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.calls import Composition
from nerfro.cli.entry import entry_point
from nerfro.cli.overrides import print_next
from nerfro.masks.options import MaskConfig
from nerfro.masks.segment import segment_composed
from nerfro.rendering.scene_file import with_scene


@entry_point("mask", MaskConfig, expand=with_scene)
def main(config: DictConfig) -> None:
    """Segment the outlined views, then all other views, write the missing masks, and print the next command."""
    capture = segment_composed(Composition.of_job(config))
    print_next("next", "preprocess", capture.overrides)


if __name__ == "__main__":
    main()
