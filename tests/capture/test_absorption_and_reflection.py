"""Absorption and reflection of a body, from photographs of it under a sky in closed form."""

import math

import pytest
import torch

from nerfro.capture.object_errors import absorption_and_reflection
from nerfro.capture.surroundings import Observations, Surroundings
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
    absorbed, reflects = absorption_and_reflection(observations, body)
    assert reflects == (branches == "all")
    # A parallel beam crosses 2 R sqrt(1 - (b / n)^2), with a mean of 2 R (1 - (1 - 1 / n^2)^1.5) n^2 2 / 3.
    length = 2 * RADIUS * (1 - (1 - 1 / 1.5**2) ** 1.5) * 1.5**2 * 2 / 3
    for share, coefficient in zip(absorbed, absorption, strict=True):
        assert share == pytest.approx(1 - math.exp(-coefficient * length), abs=0.04)


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
