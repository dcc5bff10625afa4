"""Random numbers that are a function of seed, step, stream, index and dimension."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from nerfro.core.draws import Draws, philox4x32
from nerfro.kernels.philox import _philox4x32, fill_uniform

# Counter, key and words of philox4x32-10 in Random123's known answers (kat_vectors).
KNOWN = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


def draws(num: int = 500, seed: int = 2**63 + 11, step: int = 7) -> Draws:
    return Draws(seed, step, torch.arange(num))


@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_generator_gives_the_published_words_in_python_numpy_torch_and_numba(counter, key, words) -> None:
    assert philox4x32(*counter, *key) == words
    assert _philox4x32(*counter, *key) == words
    for array in (np.array, torch.tensor):
        found = philox4x32(*(array([word]) for word in counter), *key)
        assert tuple(int(word[0]) for word in found) == words


@pytest.mark.parametrize("num", [1, 4, 7, 33])
def test_kernels_draw_the_same_numbers(num: int) -> None:
    given = draws(20)
    found = np.empty((20, num), np.float32)
    for index in range(20):
        fill_uniform(found[index], index, *given.counters("samples"))
    assert torch.equal(torch.from_numpy(found), given.uniform(given.ray, num, "samples"))


def test_number_depends_only_on_seed_step_stream_index_and_dimension() -> None:
    given = draws()
    numbers = given.uniform(given.ray, 9, "samples")
    some = torch.tensor([400, 3, 3, 77])
    torch.rand(5)
    assert torch.equal(given.uniform(some, 9, "samples"), numbers[some]), "whatever else is drawn, in any order"
    assert torch.equal(given.uniform(given.ray, 5, "samples"), numbers[:, :5])
    assert torch.equal(replace(given, ray=some).for_rays(torch.tensor([1, 1, 2]), 9), numbers[[3, 3, 3]])
    others = [draws(seed=12), draws(step=8), draws(seed=11)]
    for other in [*(d.uniform(given.ray, 9, "samples") for d in others), given.uniform(given.ray, 9, "others")]:
        assert (other == numbers).float().mean() < 0.01


def test_numbers_are_uniform_and_independent() -> None:
    """For 40,000 of them a correlation scatters by 0.005; six deviations."""
    given, next_step = draws(10_000), draws(10_000, step=8)
    numbers = given.uniform(given.ray, 4, "samples").double()
    assert 0 <= numbers.min() < 1e-3
    assert 1 - 1e-3 < numbers.max() < 1
    assert stats.kstest(numbers.flatten().numpy(), "uniform").pvalue > 1e-3
    pairs = {
        "dimensions": (numbers[:, :-1], numbers[:, 1:]),
        "rays": (numbers[:-1], numbers[1:]),
        "steps": (numbers, next_step.uniform(given.ray, 4, "samples").double()),
        "streams": (numbers, given.uniform(given.ray, 4, "others").double()),
    }
    for name, pair in pairs.items():
        correlation = float(np.corrcoef(*(values.flatten().numpy() for values in pair))[0, 1])
        assert abs(correlation) < 0.03, name
