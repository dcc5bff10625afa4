"""`python -m nerfro.reconstruct images=PHOTOS masks=MASKS out=DIR`: reconstruct a scene from photographs.

The refractive index is estimated from the photographs unless `medium.ior` is given.

Examples:
    nerfro reconstruct images=photographs masks=masks out=outputs/glass
    nerfro reconstruct video=glass.mp4 mask='view=true' out=outputs/glass train='trainer.max_time=10m'
"""

from __future__ import annotations

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.cli.overrides import is_given, of_groups
from nerfro.core.paths import resolve_path, user_path
from nerfro.data.lazy_images import decoded_once
from nerfro.files.folder_lock import lock_folder
from nerfro.pipeline.options import ReconstructConfig, have_poses
from nerfro.pipeline.stage import terminated_in_one_line
from nerfro.pipeline.stages import calibrate, preprocess, report, segment, train
from nerfro.rendering.scene_file import with_scene


@entry_point("reconstruct", ReconstructConfig, expand=with_scene, verbatim=("calibrate", "mask", "preprocess", "train"))
def main(config: DictConfig) -> None:
    """Run all stages that are not done."""
    overrides = list(HydraConfig.get().overrides.task)
    posed, out = have_poses(config, overrides), user_path(config.out)
    with lock_folder(out, "out"), terminated_in_one_line(), decoded_once():
        root = resolve_path(config.data.root) if posed else out
        data = of_groups(("data",), overrides)
        if not posed:
            data = calibrate(config, data, out)
        if not is_given("data", data):
            data = ["data=opencv", *data]
        segment(config, [*data, *of_groups(("outlines",), overrides)], root)
        scene = preprocess(config, [*data, *of_groups(("medium",), overrides)], root, out / "surface")
        train(config, overrides, scene, out)
        report(out)


if __name__ == "__main__":
    main()
