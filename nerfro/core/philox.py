"""Philox 4x32-10, a counter-based random number generator (Salmon et al. 2011, section 3.3).

The function is written in 64-bit integers that hold 32-bit words, so that the same source runs on PyTorch tensors, on
NumPy arrays, on Python's integers, and compiled by Numba, with the same bits.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from torch import Tensor

Words = TypeVar("Words", int, np.ndarray, Tensor)

_MULTIPLIER_0, _MULTIPLIER_1 = 0xD2511F53, 0xCD9E8D57
_WEYL_0, _WEYL_1 = 0x9E3779B9, 0xBB67AE85  # golden ratio and sqrt(3) - 1, added to the key in each round
_WORD = 0xFFFFFFFF


def philox4x32(c0: Words, c1: Words, c2: Words, c3: Words, key_0: int, key_1: int) -> tuple[Words, Words, Words, Words]:
    """Compute four random 32-bit words from a counter of four words and a key of two."""
    for _ in range(10):
        # Products of 64 bits may overflow into the sign, which the masks remove.
        product_0, product_1 = c0 * _MULTIPLIER_0, c2 * _MULTIPLIER_1
        c0, c2 = ((product_1 >> 32) & _WORD) ^ c1 ^ key_0, ((product_0 >> 32) & _WORD) ^ c3 ^ key_1
        c1, c3 = product_1 & _WORD, product_0 & _WORD
        key_0, key_1 = (key_0 + _WEYL_0) & _WORD, (key_1 + _WEYL_1) & _WORD
    return c0, c1, c2, c3
