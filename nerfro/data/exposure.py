"""How bright photographs were taken, as their files tell it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.data.image_files import read_exposure


def exif_exposures(files: Sequence[Path]) -> Float[Tensor, "V"] | None:
    """Exposure of each photograph, t ISO / N^2: linear radiance that its sensor saw, up to one factor for all.

    None unless every file has an exposure time, and all or none have an f-number, and a sensitivity.
    """
    known = [read_exposure(path) for path in files]
    if not known or any(time is None for time, *_ in known):
        return None
    times, numbers, sensitivities = zip(*known, strict=True)
    exposures = torch.tensor(times, dtype=torch.float64)
    for values, power in ((numbers, -2), (sensitivities, 1)):
        if any(value is not None for value in values):
            if None in values:
                return None
            exposures = exposures * torch.tensor(values, dtype=torch.float64) ** power
    return exposures
