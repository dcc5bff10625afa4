"""Random numbers of training as a function of (seed, step, ray, dimension)."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

# Philox 4x32-10, a counter-based random number generator (Salmon et al. 2011, section 3.3). The function is written in
# 64-bit integers that hold 32-bit words, so that the same source runs on PyTorch tensors, on NumPy arrays, on Python's
# integers, and compiled by Numba, with the same bits.
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


@dataclass(frozen=True)
class Draws:
    """Random numbers of one training step.

    Each number is a function of the seed, the step, the name of a stream, an index and a dimension (Philox 4x32-10 with
    the seed as key and the other values as counter). Numbers do not depend on earlier draws, on the process, on the
    chunk of the ray, or on the device. Equal arguments return equal numbers, so each purpose needs a stream of its own.

    Attributes:
        seed: seed of the run, from 0 to 2^64 - 1.
        step: number of the training step.
        ray: index of each ray of the batch in the random numbers, from 0 to 2^32 - 1 and unique within a step.
    """

    seed: int
    step: int
    ray: Int[Tensor, "R"]

    def for_rays(self, ray: Int[Tensor, "P"], num: int, stream: str = "samples") -> Float[Tensor, "P num"]:
        """Draw uniform numbers in [0, 1) for polylines; the polylines of a ray share the numbers.

        Args:
            ray: number of the ray of each polyline, `Path.ray`.
            num: numbers for each ray.
            stream: name of the purpose.
        """
        return self.uniform(self.ray[ray], num, stream)

    def uniform(self, index: Int[Tensor, " rows"], num: int, stream: str) -> Float[Tensor, "rows num"]:
        """Draw uniform multiples of 2^-24 in [0, 1), in single precision.

        Args:
            index: index of each row of numbers, from 0 to 2^32 - 1.
            num: numbers for each index.
            stream: name of the purpose.
        """
        return (self.words(index, num, stream) >> 8).float() * 2.0**-24

    def words(self, index: Int[Tensor, " rows"], num: int, stream: str) -> Int[Tensor, "rows num"]:
        """Draw uniform integers from 0 to 2^32 - 1; the arguments are those of `uniform`."""
        block = torch.arange(-(-num // 4), device=index.device)
        index = index[:, None].expand(-1, len(block))
        key_0, key_1, step, stream_number = self.counters(stream)
        words = philox4x32(block.expand_as(index), index, torch.full_like(index, stream_number),
                           torch.full_like(index, step), key_0, key_1)  # fmt: skip
        return torch.stack(words, -1).flatten(1)[:, :num]

    def counters(self, stream: str) -> tuple[int, int, int, int]:
        """Return the words of key, step and stream, for kernels that draw numbers."""
        low, high = self.seed & 0xFFFFFFFF, self.seed >> 32 & 0xFFFFFFFF
        return low, high, self.step & 0xFFFFFFFF, zlib.crc32(stream.encode())
