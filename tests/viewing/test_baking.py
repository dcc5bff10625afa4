"""Baked data of a page match the model, and survive their encoding as images."""

import base64
import io
import math

import numpy as np
import pytest
import torch
from PIL import Image

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.types import Exits
from nerfro.viewing.baking import bake_sky, cube_directions, pack, shared_exponent


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


def test_cube_map_directions_match_opengl() -> None:
    size = 5
    for number, direction in enumerate(cube_directions(size).double().numpy()):
        # The shader's way from a direction to the place in the cube: equal angles.
        warped = np.arctan(direction / np.abs(direction).max()) * 4 / np.pi
        face, s, t = gl_face(warped)
        expected = number // size**2, (number % size + 0.5) / size, (number // size % size + 0.5) / size
        assert (face, s, t) == pytest.approx(expected, abs=1e-6)


def test_baked_sky_matches_the_background() -> None:
    background = EnvironmentMap([2, 8])
    torch.nn.init.normal_(background.texels, std=3, generator=torch.Generator().manual_seed(0))
    baked = bake_sky(background, torch.device("cpu"))
    upper, rest = (baked.voxels[name].astype(int) for name in ("sky", "sky_exponent"))
    found = (upper * 2 + (rest >> [0, 1, 2] & 1)) * 2.0 ** ((rest >> 3) - 24)
    radiance = background(Exits(cube_directions(8))).detach().view(6, 8, 8, 3).numpy()
    assert (np.abs(found - radiance) <= radiance.max(-1, keepdims=True) / 500).all()


def unpacked(uri: str, shape: tuple[int, int, int]) -> np.ndarray:
    """The slices of a picture, one by one, as the page's `unpackVoxels` finds them."""
    depth, height, width = shape
    columns = math.ceil(math.sqrt(depth))
    mosaic = np.array(Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))))
    return np.stack(
        [
            mosaic[z // columns * height : (z // columns + 1) * height, z % columns * width : (z % columns + 1) * width]
            for z in range(depth)
        ]
    )


@pytest.mark.parametrize("shape", [(1, 2, 3, 1), (5, 4, 3, 2), (6, 8, 8, 3)])
def test_pack_keeps_every_byte(shape: tuple[int, ...]) -> None:
    voxels = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    found = unpacked(pack(voxels), shape[:3])
    np.testing.assert_array_equal(found[..., : shape[3]], voxels)
    assert not found[..., shape[3] :].any()


def test_shared_exponent_has_nine_bits_of_precision() -> None:
    radiance = np.random.default_rng(0).lognormal(0, 3, (1000, 3))
    radiance = np.concatenate([radiance, [[0, 0, 0], [1, 1, 1], [0.99999, 0.5, 0], [1e-9, 0, 0], [65408, 1, 0]]])
    upper, rest = shared_exponent(radiance)
    # OpenGL ES 3.0, section 3.8.3.2: mantissa 2^(exponent - 15 - 9).
    mantissa = upper.astype(int) * 2 + (rest.astype(int) >> [0, 1, 2] & 1)
    found = mantissa * 2.0 ** ((rest.astype(int) >> 3) - 24)
    brightest = radiance.max(-1, keepdims=True)
    assert (np.abs(found - radiance) <= np.maximum(brightest / 512, 2.0**-25) * (1 + 1e-9)).all()
