"""What a page is made of stands for what the model traces and shows."""

import numpy as np
import pytest
import torch

from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.types import Exits
from nerfro.viewing.baking import bake_sky, cube_directions


def gl_face(direction: np.ndarray) -> tuple[int, float, float]:
    """Face and texture coordinates of a direction, by OpenGL ES 3.0, table 3.21, written out."""
    x, y, z = direction
    axis = int(np.abs(direction).argmax())
    positive = direction[axis] > 0
    if axis == 0:
        face, s, t, m = (0, -z, -y, x) if positive else (1, z, -y, -x)
    elif axis == 1:
        face, s, t, m = (2, x, z, y) if positive else (3, x, -z, -y)
    else:
        face, s, t, m = (4, x, -y, z) if positive else (5, -x, -y, -z)
    return face, (s / m + 1) / 2, (t / m + 1) / 2


def test_cube_directions_lie_where_opengl_looks_them_up() -> None:
    size = 5
    for number, direction in enumerate(cube_directions(size).double().numpy()):
        # The shader's way from a direction to the place in the cube: equal angles.
        warped = np.arctan(direction / np.abs(direction).max()) * 4 / np.pi
        face, s, t = gl_face(warped)
        expected = number // size**2, (number % size + 0.5) / size, (number // size % size + 0.5) / size
        assert (face, s, t) == pytest.approx(expected, abs=1e-6)


def test_sky_is_the_boundary() -> None:
    boundary = EnvironmentMap([2, 8])
    torch.nn.init.normal_(boundary.texels, std=3, generator=torch.Generator().manual_seed(0))
    baked = bake_sky(boundary, torch.device("cpu"))
    upper, rest = (baked.voxels[name].astype(int) for name in ("sky", "sky_exponent"))
    found = (upper * 2 + (rest >> [0, 1, 2] & 1)) * 2.0 ** ((rest >> 3) - 24)
    radiance = boundary(Exits(cube_directions(8))).detach().view(6, 8, 8, 3).numpy()
    assert (np.abs(found - radiance) <= radiance.max(-1, keepdims=True) / 500).all()
