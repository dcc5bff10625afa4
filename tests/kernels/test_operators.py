"""Kernels as operators: each passes `torch.library.opcheck`, and has results of the same shapes on fake tensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from nerfro.backgrounds import cube_map
from nerfro.fields import hash_encoding, relu_mlp
from nerfro.fields.spherical_harmonics import spherical_harmonics
from nerfro.samplers.paths import compiled
from nerfro.testing import example_rays
from tests.closed_forms import grid_points, sampled

BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])
LEVELS = hash_encoding.grid_levels(num_levels=3, base_resolution=2, finest_resolution=8, log2_table_size=6)
CUBE = cube_map.CubeLevels((1, 2))


def hash_encode() -> tuple[Any, ...]:
    positions, table = torch.rand(5, 3), torch.rand(LEVELS.num_entries, 2)
    return hash_encoding.hash_encode, positions, table, LEVELS.resolutions, LEVELS.sizes


def harmonics() -> tuple[Any, ...]:
    return spherical_harmonics, torch.nn.functional.normalize(torch.randn(5, 3), dim=-1), 4


def mlp() -> tuple[Any, ...]:
    return relu_mlp.relu_mlp, [torch.randn(5, 3), torch.randn(5, 2)], [torch.randn(4, 5), torch.randn(2, 4)], False


def cube_lookup() -> tuple[Any, ...]:
    face, coordinates = cube_map.project(torch.nn.functional.normalize(torch.randn(5, 3), dim=-1))
    padded = torch.cat([cube_map.padded_texels(n).flatten() for n in CUBE.resolutions])
    return cube_map.lookup, face, coordinates, torch.randn(CUBE.num_texels, 3), padded, CUBE.resolutions


LEARNING = [hash_encode, harmonics, mlp, cube_lookup]


def trace_snell() -> tuple[Any, ...]:
    medium = sampled(grid_points(1.5, 20).norm(dim=-1)[None] - 0.8, BOX, [1.5], 0.01)
    rays, solids = example_rays(6), medium.packed()
    packed = [torch.from_numpy(values) for values in solids if isinstance(values, np.ndarray)]
    settings = solids.nested, solids.shell, [], 0, 0.0, 16, 2, 0.02, False
    return compiled._trace, rays.origins, rays.directions, rays.near, rays.far, packed, *settings


def learned(values: Any) -> Any:
    """Let floating-point tensors require gradients."""
    if isinstance(values, list):
        return [learned(value) for value in values]
    floats = isinstance(values, Tensor) and values.is_floating_point()
    return values.clone().requires_grad_() if floats else values


@pytest.mark.parametrize("case", LEARNING)
def test_operator_passes_the_checks_of_torch(case: Callable[[], tuple[Any, ...]]) -> None:
    function, *arguments = case()
    torch.library.opcheck(function, tuple(arguments))
    torch.library.opcheck(function, tuple(learned(values) for values in arguments))


def test_tracing_passes_the_checks_of_torch() -> None:
    function, *arguments = trace_snell()
    torch.library.opcheck(function, tuple(arguments))


@pytest.mark.parametrize("case", LEARNING)
def test_operator_has_the_same_shapes_on_fake_tensors_and_in_compiled_code(
    case: Callable[[], tuple[Any, ...]],
) -> None:
    function, *arguments = case()
    expected = function(*arguments)
    with FakeTensorMode(allow_non_fake_inputs=True):
        fake = function(*arguments)
    assert fake.shape == expected.shape
    assert fake.dtype == expected.dtype
    in_graph = torch.compile(lambda *given: function(*given) + 0, backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(in_graph(*arguments), expected)


@pytest.mark.parametrize("case", LEARNING)
def test_other_devices_compute_the_same_values(case: Callable[[], tuple[Any, ...]]) -> None:
    function, *arguments = case()
    torch.testing.assert_close(function.decompose(*arguments), function(*arguments), rtol=1e-5, atol=1e-5)
