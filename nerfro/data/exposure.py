"""Relative exposures from the EXIF data of photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.data.image_files import read_exposure


def exif_exposures(files: Sequence[Path]) -> Float[Tensor, "V"] | None:
    """Compute the relative exposure t ISO / N^2 of each photograph.

    A factor that no file records (f-number N or sensitivity ISO) is assumed to be equal for all photographs.

    Returns:
        Exposures in arbitrary units, or None if a file lacks its exposure time t or only some files record a factor.
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
