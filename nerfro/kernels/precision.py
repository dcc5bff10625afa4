"""Number formats in which a machine multiplies fast."""

from __future__ import annotations

import torch


def fast_bfloat16(device: str) -> bool:
    """Return whether matrix products in bfloat16 are faster than in float32 on a device: `cpu`, `cuda`, ...

    Processors without bfloat16 units compute each number separately: with AVX2, a product of 16384x64 and 64x64
    takes 40 times as long as in float32. ARM's units are not used, because PyTorch does not report them.
    """
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device == "cpu" and torch.cpu._is_avx512_bf16_supported()
