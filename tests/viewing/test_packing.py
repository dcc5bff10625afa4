"""Arrays come back from their pictures as they were."""

import base64
import io
import math

import numpy as np
import pytest
from PIL import Image

from nerfro.viewing.packing import pack, shared_exponent


def unpacked(uri: str, shape: tuple[int, int, int]) -> np.ndarray:
    """The slices of a picture, one by one, as the page's `voxelsOf` finds them."""
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


def test_shared_exponent_is_as_near_as_nine_bits_are() -> None:
    radiance = np.random.default_rng(0).lognormal(0, 3, (1000, 3))
    radiance = np.concatenate([radiance, [[0, 0, 0], [1, 1, 1], [0.99999, 0.5, 0], [1e-9, 0, 0], [65408, 1, 0]]])
    upper, rest = shared_exponent(radiance)
    # OpenGL ES 3.0, section 3.8.3.2: mantissa 2^(exponent - 15 - 9).
    mantissa = upper.astype(int) * 2 + (rest.astype(int) >> [0, 1, 2] & 1)
    found = mantissa * 2.0 ** ((rest.astype(int) >> 3) - 24)
    brightest = radiance.max(-1, keepdims=True)
    assert (np.abs(found - radiance) <= np.maximum(brightest / 512, 2.0**-25) * (1 + 1e-9)).all()
