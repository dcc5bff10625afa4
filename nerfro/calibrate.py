"""`python -m nerfro.calibrate images=DIR target=apriltag out=DIR`: estimate lens and poses of photographs.

Examples:
    nerfro calibrate images=photographs target=apriltag out=data/glass
    nerfro calibrate images=photographs target=colmap lens=radial out=data/glass
"""

from __future__ import annotations

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.cli.overrides import print_next
from nerfro.poses.calibrate import calibrate
from nerfro.poses.options import CalibrateConfig


@entry_point("calibrate", CalibrateConfig)
def main(options: CalibrateConfig) -> None:
    """Detect the board, estimate lens and poses, write the data set, and print the next command."""
    capture = calibrate(options)
    if options.images is not None:
        following, added = ("preprocess", []) if capture.masks else ("mask", ["view=true"])
        print_next("next", following, [*capture.overrides, *added])


if __name__ == "__main__":
    main()
