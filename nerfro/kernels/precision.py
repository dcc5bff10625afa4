"""Which kind of number a machine multiplies fast."""

from __future__ import annotations

import torch


def fast_bfloat16(device: str) -> bool:
    """Whether products in bfloat16 are faster than in float32 on a device: `cpu`, `cuda`, ...

    A processor without units for it computes each number on its own: with AVX2 alone a product of 16384x64 and 64x64
    takes 40 times as long as in float32. Units that PyTorch does not tell of (ARM's) are not used.
    """
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device == "cpu" and torch.cpu._is_avx512_bf16_supported()
