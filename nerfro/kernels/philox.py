"""The random number generator of `nerfro.core.draws` for kernels."""

from __future__ import annotations

import numpy as np

from nerfro.core.draws import philox4x32
from nerfro.kernels.compilation import compiled

_philox4x32 = compiled(philox4x32)


@compiled
def fill_uniform(numbers, index, key_0, key_1, step, stream):
    """Fill a row with what `Draws.uniform` returns for one index."""
    for first in range(0, len(numbers), 4):
        words = _philox4x32(first // 4, index, stream, step, key_0, key_1)
        for offset in range(min(4, len(numbers) - first)):
            numbers[first + offset] = np.float32(words[offset] >> 8) * np.float32(2.0**-24)
