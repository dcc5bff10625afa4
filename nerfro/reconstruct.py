"""`python -m nerfro.reconstruct images=PHOTOS masks=MASKS out=DIR`: reconstruct a scene from photographs.

The refractive index is estimated from the photographs unless `medium.ior` is given.

Examples:
    nerfro reconstruct images=photographs masks=masks out=outputs/glass
    nerfro reconstruct video=glass.mp4 mask='view=true' out=outputs/glass train='trainer.max_time=10m'
"""

from __future__ import annotations

from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.calls import Composition
from nerfro.cli.entry import entry_point
from nerfro.pipeline.options import STAGES, ReconstructConfig
from nerfro.pipeline.reconstruct import reconstruct_composed
from nerfro.pipeline.stage import terminated_in_one_line
from nerfro.rendering.scene_file import with_scene


@entry_point("reconstruct", ReconstructConfig, expand=with_scene, verbatim=tuple(STAGES))
def main(config: DictConfig) -> None:
    """Run all stages that are not done."""
    with terminated_in_one_line():
        reconstruct_composed(Composition.of_job(config))


if __name__ == "__main__":
    main()
