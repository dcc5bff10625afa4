"""Absorption and reflection of a body, from photographs of it under a sky in closed form."""

import math

import pytest
import torch
from torch import Tensor

from nerfro.capture.object_errors import observed_light
from nerfro.capture.surroundings import CLIPPED_RADIANCE, Observations, Surroundings, recorded_and_clipped
from nerfro.core.types import Exits
from nerfro.rendering.scene_file import Provenance, SceneFile
from nerfro.samplers.paths.snell import Snell
from tests.ball_photographs import RADIUS, mesh, photographs_of, sky, solid


@pytest.mark.parametrize(("absorption", "branches"), [((0.0, 0.0, 0.0), "none"), ((0.1, 0.25, 0.8), "all")])
def test_absorbed_light_and_reflection_are_measured(absorption: tuple[float, ...], branches: str) -> None:
    """The mean of the lengths over pixels of the object is about that of the refracted rays through a ball."""
    body = solid([1.5])
    coefficients = torch.tensor([absorption])
    views = photographs_of(body.with_absorption_coefficients(coefficients), sampler=Snell(branches=branches))
    observations = Observations(views, mesh(), False)
    colours = sky(observations.through.rays.directions)
    observations.surroundings = Surroundings(lambda exits: sky(exits.directions), None, 0.0, colours)
    light = observed_light(observations, body)
    assert light.reflects == (branches == "all")
    # A parallel beam crosses 2 R sqrt(1 - (b / n)^2), with a mean of 2 R (1 - (1 - 1 / n^2)^1.5) n^2 2 / 3.
    length = 2 * RADIUS * (1 - (1 - 1 / 1.5**2) ** 1.5) * 1.5**2 * 2 / 3
    for share, coefficient in zip(light.absorbed, absorption, strict=True):
        assert share == pytest.approx(1 - math.exp(-coefficient * length), abs=0.04)


def test_air_in_a_body_does_not_absorb() -> None:
    """A hollow ball of glass, whose air would absorb as much as its wall."""
    body = solid([1.5, 1.0])
    wall = torch.tensor([[0.4, 0.8, 1.6], [0.0, 0.0, 0.0]])
    views = photographs_of(body.with_absorption_coefficients(wall), sampler=Snell(branches="all"))
    observations = Observations(views, mesh(), False)
    colours = sky(observations.through.rays.directions)
    observations.surroundings = Surroundings(lambda exits: sky(exits.directions), None, 0.0, colours)
    assert observed_light(observations, body).absorption == pytest.approx(wall, rel=0.03)


def test_radiance_that_photographs_clip_is_measured_through_an_absorbing_body() -> None:
    """A sky that is 2.5 wherever it would exceed 0.6, of which photographs record 1."""

    def bright(exits: Exits) -> Tensor:
        return sky(exits.directions).where(sky(exits.directions) < 0.6, 2.5)

    body, coefficients = solid([1.5]), torch.tensor([[0.4, 0.8, 1.6]])
    absorbing = body.with_absorption_coefficients(coefficients)
    views = photographs_of(absorbing, around=bright, sampler=Snell(branches="all"))
    observations = Observations(views, mesh(), False)
    exits = Exits.unbent(observations.views.cameras.image_rays(0))
    is_bright = bright(exits) > 1
    share = recorded_and_clipped(observations.surroundings.background(exits))[1]
    assert share[is_bright].mean() > 0.9
    assert share[~is_bright].mean() < 0.1
    colours = observations.surroundings.colours
    observations.surroundings = Surroundings(
        lambda exits: bright(exits).clamp(max=CLIPPED_RADIANCE), None, 0.0, colours
    )
    light = observed_light(observations, body)
    assert light.absorption == pytest.approx(coefficients, rel=0.03)
    assert light.clipped_radiance == pytest.approx(torch.full((3,), 2.5), rel=0.03)


@pytest.mark.parametrize(
    ("surroundings", "origin", "expected"),
    [
        ("far", Provenance(), {}),
        ("far", Provenance(absorbed=[0.0, 0.0, 0.0], reflects=False), {}),
        ("far", Provenance(absorbed=[0.0, 0.0, 0.0], reflects=True), {"experiment": "glass"}),
        ("far", Provenance(absorbed=[0.0, 0.1, 0.5], reflects=False), {"experiment": "glass"}),
        ("near", Provenance(absorbed=[0.0, 0.0, 0.0], reflects=True), {"experiment": "glass_room"}),
        (
            "near",
            Provenance(absorbed=[0.0, 0.1, 0.5], reflects=True),
            {"experiment": "glass_room", "medium.learn_absorption": True},
        ),
    ],
)
def test_advice_of_preprocess_follows_from_what_was_measured(
    surroundings: str, origin: Provenance, expected: dict[str, object]
) -> None:
    assert SceneFile(surroundings=surroundings, provenance=origin).training_options == expected
