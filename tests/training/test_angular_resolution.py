"""The background resolves pixels of the photographs, up to a limit."""

import pytest
from omegaconf import OmegaConf

from nerfro.registry import discover, find
from nerfro.training.angular_resolution import settle_angular_resolution
from tests.exact_silhouettes import cameras_around


@pytest.mark.parametrize(
    ("side", "fits", "given", "descent", "finest"),
    [
        (64, True, None, 128, 128),
        (128, True, None, 256, 256),
        (256, True, None, 256, 512),
        (256, False, None, 512, 512),
        (4000, True, None, 256, 1024),
        (4000, False, None, 512, 512),
        (256, True, [4, 32], 32, 32),
    ],
)
def test_finest_texel_follows_the_pixel(
    side: int, fits: bool, given: list[int] | None, descent: int, finest: int
) -> None:
    discover()
    cameras = cameras_around(3, side, focal=1.4)
    boundary = {"_target_": find("boundary", "envmap").target, "resolutions": given, "fitted_resolutions": None}
    config = OmegaConf.create({
        "boundary": boundary,
        "content": {"space": "box"},
        "loss": {"total_variation": {"weight": 1.0, "angle": None}},
        "phase": {"background": {"steps": 10 if fits else 0}},
    })  # fmt: skip
    settle_angular_resolution(config, cameras)
    assert max(config.boundary.resolutions) == descent
    assert max([*config.boundary.resolutions, *(config.boundary.fitted_resolutions or ())]) == finest
    if given is None and side < 4000 and fits:
        pixel = 57.3 / (1.4 * side)
        assert 2**-0.5 < (90 / finest) / pixel < 2**0.5
    assert config.loss.total_variation.angle == pytest.approx(2 * 90 / descent)
