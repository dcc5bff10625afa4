import numpy as np

from nerfro.files import lat_long


def test_only_edges_of_the_sky_are_averaged_over_texels():
    def half(directions):
        return np.repeat(directions[..., :1] > 0.123, 3, -1).astype(float)

    height = 64
    texture = lat_long.envmap_texture(half, height, np.eye(3))[..., 0]
    theta = np.pi * np.arange(height)[:, None] / (height - 1)
    phi = 2 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height)
    distance = np.abs(np.arcsin(np.sin(theta) * np.sin(phi)) - np.arcsin(0.123))
    texel = np.pi / height
    away = distance > 2 * texel
    assert np.array_equal(texture[away], (np.sin(theta) * np.sin(phi) > 0.123)[away])
    crossed = (texture > 0) & (texture < 1)
    assert crossed.any()
    assert distance[crossed].max() < texel
