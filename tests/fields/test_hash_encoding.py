"""The hash encoding: interpolation in plain PyTorch, and the compiled kernels against it."""

import pytest
import torch

from nerfro.fields import hash_encoding
from nerfro.fields.hash_encoding import hash_encode, hash_encode_in_torch
from nerfro.kernels.constants import cached_constant
from tests.gradients import require_equal_gradients

# Two dense levels and three hashed ones, the last of them much finer than its table.
LEVELS = hash_encoding.grid_levels(num_levels=5, base_resolution=4, finest_resolution=64, log2_table_size=10)
LAYOUT = LEVELS.resolutions, LEVELS.sizes


def random_table(seed: int = 0) -> torch.Tensor:
    return torch.randn(LEVELS.num_entries, 2, generator=torch.Generator().manual_seed(seed))


def random_positions(num_points: int) -> torch.Tensor:
    """Points in the unit cube, with its corners, faces and a few outside among them."""
    points = torch.rand(num_points, 3, generator=torch.Generator().manual_seed(1))
    special = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5], [0.25, 1, 0.75], [-0.5, 0.5, 1.5], [0.5, 2, -3]])
    return torch.cat([points, special])


def test_levels_grow_geometrically_and_only_large_levels_are_hashed() -> None:
    assert LEVELS.resolutions == (4, 8, 16, 32, 64)
    assert LEVELS.dense == (True, True, False, False, False)
    assert LEVELS.sizes == (125, 729, 1024, 1024, 1024)
    assert LEVELS.num_entries == sum(LEVELS.sizes)


@pytest.mark.parametrize("encode", [hash_encode_in_torch, hash_encode])
def test_dense_levels_reproduce_trilinear_functions(encode) -> None:
    # Trilinear interpolation is exact for 1, x, y, z, xy, ..., xyz; entries are ordered with x fastest.
    levels = hash_encoding.grid_levels(num_levels=2, base_resolution=3, finest_resolution=7, log2_table_size=12)

    def functions(p: torch.Tensor) -> torch.Tensor:
        x, y, z = p.unbind(-1)
        return torch.stack([1 + 2 * x - 3 * y + 5 * z, x * y * z - 2 * y * z], -1)

    vertices = []
    for n in levels.resolutions:
        k, j, i = torch.meshgrid(*[torch.linspace(0, 1, n + 1)] * 3, indexing="ij")
        vertices.append(torch.stack([i, j, k], -1).reshape(-1, 3))
    positions = torch.rand(100, 3, generator=torch.Generator().manual_seed(2))
    encoded = encode(positions, functions(torch.cat(vertices)), levels.resolutions, levels.sizes)
    torch.testing.assert_close(encoded, functions(positions).repeat(1, 2), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("encode", [hash_encode_in_torch, hash_encode])
def test_encoding_is_continuous_across_cells(encode) -> None:
    # Steps of 2^-18 across the faces of all levels' cells: no feature may jump by more than its steepest slope allows.
    table, step = random_table(), 2.0**-18
    face = torch.arange(1, 64) / 64
    around = face[:, None] + torch.tensor([-step, step])
    positions = torch.stack([around, torch.full_like(around, 0.3), torch.full_like(around, 0.7)], -1)
    encoded = encode(positions.reshape(-1, 3), table, *LAYOUT).view(63, 2, -1)
    steepest = 2 * table.abs().max() * 64
    assert (encoded[:, 1] - encoded[:, 0]).abs().max() < steepest * 2 * step


@pytest.mark.parametrize("num_points", [0, 1, 3000])
def test_kernels_match_the_reference_forward_and_backward(num_points: int) -> None:
    inputs = (random_positions(num_points).requires_grad_(), random_table().requires_grad_())
    encoded, expected = hash_encode(*inputs, *LAYOUT), hash_encode_in_torch(*inputs, *LAYOUT)
    torch.testing.assert_close(encoded, expected, rtol=1e-5, atol=1e-5)
    require_equal_gradients(encoded, expected, inputs)


def test_positions_have_gradients_after_an_evaluation() -> None:
    # Tensors made in inference mode, as pictures are, cannot be saved for a gradient, and constants are kept.
    cached_constant.cache_clear()
    positions = random_positions(9).requires_grad_()
    with torch.inference_mode():
        hash_encode_in_torch(positions, random_table(), *LAYOUT)
    hash_encode_in_torch(positions, random_table(), *LAYOUT).sum().backward()
    assert positions.grad.any()


@pytest.mark.slow
def test_gradient_does_not_depend_on_the_number_of_threads() -> None:
    threads, gradients = torch.get_num_threads(), []
    try:
        for wanted in (1, 2):
            torch.set_num_threads(wanted)
            table = random_table().requires_grad_()
            hash_encode(random_positions(5000), table, *LAYOUT).sin().sum().backward()
            gradients.append(table.grad)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*gradients)


def test_nan_positions_give_nan() -> None:
    encoded = hash_encode(torch.full((4, 3), float("nan")), random_table(), *LAYOUT)
    assert encoded.isnan().all()


def test_hashed_vertices_spread_over_the_table() -> None:
    # 65^3 vertices in 1024 entries: a fair hash leaves each entry with 268 +- 16 of them; allow twenty sigma.
    n = torch.arange(65)
    vertices = torch.stack(torch.meshgrid(n, n, n, indexing="ij"), -1).reshape(-1, 3) / 64
    table = torch.zeros(LEVELS.num_entries, 2, requires_grad=True)
    hash_encode(vertices, table, *LAYOUT)[:, -2:].sum().backward()
    counts = table.grad[LEVELS.offsets[-1] :, 0]
    assert counts.min() > 268 * 0.5
    assert counts.max() < 268 * 2


def test_a_single_level_has_the_finest_resolution() -> None:
    levels = hash_encoding.grid_levels(num_levels=1, base_resolution=16, finest_resolution=48, log2_table_size=20)
    assert levels.resolutions == (48,)
