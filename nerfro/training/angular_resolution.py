"""Angular resolution of the background, derived from the width of a pixel of the photographs."""

from __future__ import annotations

import math

from omegaconf import DictConfig

from nerfro.core.cameras import Cameras
from nerfro.registry.registration import find

# Texels along each side of a face of the coarsest level, and bounds of the finest one.
_COARSEST, _MIN_TEXELS, _MAX_TEXELS = 4, 64, 1024
# Bounds of the finest level of gradient descent, whose optimizer visits all texels in each step: with and without finer
# levels that `phase=background` fits.
_MAX_BESIDE_FITS, _MAX_ALONE = 256, 512
# Angle between two compared directions, in texels of the finest level of gradient descent.
_COMPARED_TEXELS = 2


def derive_angular_resolution(config: DictConfig, cameras: Cameras) -> None:
    """Set the missing resolutions of `background=envmap`, and the missing angle of `loss=total_variation`.

    A texel of the finest level is about as wide as a pixel. If a volume covers all of space, the background shows only
    what is far behind the photographed scene, and keeps the levels of its constructor.

    Args:
        config: configuration of a run, see `TrainConfig`; it is changed.
        cameras: cameras of the training views.
    """
    if config.content.space == "all" or config.background._target_ != find("background", "envmap").target:
        return
    if config.background.get("resolutions") is None:
        fits = config.phase.get("background", {}).get("steps", 0) > 0
        finest = 0.5 * math.pi * float(cameras.fx.double().median())
        finest = min(max(2 ** round(math.log2(finest)), _MIN_TEXELS), _MAX_TEXELS if fits else _MAX_ALONE)
        levels = [2**level for level in range(int(math.log2(_COARSEST)), int(math.log2(finest)) + 1)]
        descent = [n for n in levels if n <= _MAX_BESIDE_FITS or not fits]
        config.background.resolutions = descent
        if config.background.get("fitted_resolutions") is None:
            config.background.fitted_resolutions = levels[len(descent) :]
    variation = config.loss.get("total_variation")
    if variation and variation.get("angle") is None:
        config.loss.total_variation.angle = _COMPARED_TEXELS * 90 / max(config.background.resolutions)
