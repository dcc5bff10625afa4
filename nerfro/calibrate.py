"""`python -m nerfro.calibrate images=DIR target=apriltag out=DIR`: estimate lens and poses of photographs.

Examples:
    nerfro calibrate images=photographs target=apriltag out=data/glass
    nerfro calibrate images=photographs target=colmap lens=radial out=data/glass
"""

from __future__ import annotations

from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.calls import options_in
from nerfro.cli.entry import entry_point
from nerfro.cli.overrides import print_next
from nerfro.poses.calibrate import calibrate
from nerfro.poses.options import CalibrateConfig


@entry_point("calibrate", CalibrateConfig)
def main(config: DictConfig) -> None:
    """Detect the board, estimate lens and poses, write the data set, and print the next command."""
    capture = calibrate(options_in(config, CalibrateConfig))
    if config.images is not None:
        command, options = ("preprocess", []) if capture.masks else ("mask", ["view=true"])
        print_next("next", command, [*capture.overrides, *options])


if __name__ == "__main__":
    main()
