"""A scene in closed form: a coloured ball inside a ball of glass, under a smooth sky."""

import functools
import math
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.types import FieldValues, Samples
from nerfro.data.base import DataSource, Views
from nerfro.fields.base import Field
from nerfro.files import lat_long
from nerfro.media.bodies import Bodies, Body
from nerfro.media.material import Material
from nerfro.media.surfaces import BallSurface
from nerfro.models.refractive import RefractiveModel
from nerfro.registry.registration import discover
from nerfro.rendering import Components
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.points.stratified import Stratified
from nerfro.viewing.server import PageServer
from nerfro.viewing.trained_scene import TrainedScene
from tests.cameras_at import cameras_at

RADIUS, INSIDE_RADIUS, INSIDE_CENTRE, IOR = 0.8, 0.3, (0.1, 0.0, 0.05), 1.3


class SolidBall(Field):
    """Nearly opaque, of a colour that depends on the place alone."""

    def forward(self, samples: Samples) -> FieldValues:
        offset = samples.positions - torch.tensor(INSIDE_CENTRE)
        inside = torch.linalg.vector_norm(offset, dim=-1) < INSIDE_RADIUS
        return FieldValues(500.0 * inside, colour(samples.positions))


def colour(positions: torch.Tensor) -> torch.Tensor:
    return 0.4 + 0.5 * positions


def sky_of(directions: torch.Tensor) -> torch.Tensor:
    return 0.5 + 0.4 * directions


class Photographs(DataSource):
    """Cameras around the origin, and black pictures."""

    splits = ("train", "test")  # type: ignore[assignment]
    root = Path()

    def load(self, split: str) -> Views:
        places = [(4, 0, 1), (0, 4, 0.5), (-3, 2, -1)] if split == "test" else [(4, 0, 0), (0, -4, 0), (-2, 2, 2.8)]
        discover()
        look_at_origin = import_module("nerfro.synthetic.dataset").look_at_origin
        poses = np.stack([look_at_origin(np.array(place, float))[:3] for place in places])
        size = 32
        cameras = cameras_at(poses, size, size, 0.5 * size / math.tan(0.5 * 0.7))
        return Views(cameras, torch.zeros(len(places), size, size, 3), None, [f"r_{i}" for i in range(len(places))])


@functools.cache
def glass() -> Bodies:
    return Bodies([Body("object", BallSurface(RADIUS), Material(IOR))])


def make_scene() -> TrainedScene:
    sky = EnvironmentMap([64])
    sky.set_lat_long(sky_of(lat_long.directions(128)))
    parts = Components(
        medium=glass(),
        path_sampler=Snell(),
        point_sampler=Stratified(num_samples=256),
        make_field=SolidBall,
        background=sky,
    )
    return TrainedScene(RefractiveModel(parts).eval(), Photographs())


@pytest.fixture
def scene() -> TrainedScene:
    return make_scene()


@pytest.fixture
def server() -> Iterator[PageServer]:
    server = PageServer("localhost", 0)
    yield server
    server.close()
