"""The background resolves pixels of the photographs, up to a limit."""

import pytest
from omegaconf import OmegaConf

from nerfro.registry import discover, find
from nerfro.training.angular_resolution import settle_angular_resolution
from tests.exact_silhouettes import cameras_around


@pytest.mark.parametrize(
    ("side", "given", "finest"),
    [(64, None, 128), (128, None, 256), (256, None, 512), (4000, None, 512), (256, [4, 32], 32)],
)
def test_finest_texel_follows_the_pixel(side: int, given: list[int] | None, finest: int) -> None:
    discover()
    cameras = cameras_around(3, side, focal=1.4)
    boundary = {"_target_": find("boundary", "envmap").target, "resolutions": given}
    config = OmegaConf.create({
        "boundary": boundary,
        "content": {"space": "box"},
        "loss": {"total_variation": {"weight": 1.0, "angle": None}},
    })  # fmt: skip
    settle_angular_resolution(config, cameras)
    assert max(config.boundary.resolutions) == finest
    if given is None and finest < 512:
        pixel = 57.3 / (1.4 * side)
        assert 2**-0.5 < (90 / finest) / pixel < 2**0.5
    assert config.loss.total_variation.angle == pytest.approx(2 * 90 / finest)
