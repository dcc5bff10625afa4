"""The paper's background, and the constant one."""

import torch

from nerfro.backgrounds.base import ConstantBackground
from nerfro.core.types import Exits
from nerfro.paper.nerf import Skybox


def test_published_skybox_has_its_layers() -> None:
    sky = Skybox()
    assert [(layer.in_features, layer.out_features) for layer in sky.trunk.layers] == [
        (27, 128),
        (128, 128),
        (128, 128),
        (128 + 27, 128),
    ]
    assert (sky.rgb.in_features, sky.rgb.out_features) == (128, 3)


def test_constant_background_is_the_same_in_every_direction() -> None:
    rgb = ConstantBackground([0.1, 0.2, 0.3])(Exits(torch.randn(4, 5, 3)))
    assert torch.equal(rgb, torch.tensor([0.1, 0.2, 0.3]).expand(4, 5, 3))
