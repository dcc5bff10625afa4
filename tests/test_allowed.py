"""Values that annotations allow in constructors and configurations, and errors for other values."""

import math
from typing import Annotated, Literal

import pytest
from annotated_types import Gt, Le

from nerfro.geometry.space import corners_of_box
from nerfro.registry.allowed import Count, Positive, validated
from nerfro.registry.registration import create, discover, find
from tests.conftest import refused


@validated("component")
class Component:
    def __init__(
        self,
        count: Count,
        rate: Annotated[float, Gt(0), Le(2)] = 1.0,
        radius: Positive | None = None,
        sizes: list[Count] = (),  # type: ignore[assignment]
        mode: Literal["fast", "exact"] = "fast",
        finite: float = 0.0,
    ) -> None:
        self.count = count


def test_allowed_values_pass() -> None:
    assert Component(1, rate=2, radius=None, sizes=[1, 2], mode="exact").count == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "component: count=0 is not allowed; take at least 1"),
        ({"rate": 0}, "rate=0 is not allowed; take more than 0 and at most 2"),
        ({"rate": math.nan}, "rate=nan is not allowed"),
        ({"radius": math.inf}, "radius=inf is not allowed; take more than 0"),
        ({"sizes": [3, 0]}, r"sizes=\[3, 0\] is not allowed; take at least 1"),
        ({"finite": math.inf}, "finite=inf is not allowed; take a finite number"),
        ({"rate": 10**400}, "is not allowed; take more than 0"),
        ({"mode": "slow"}, "mode='slow' is not allowed; choose 'fast', 'exact'"),
    ],
)
def test_values_that_are_not_allowed_are_refused(arguments: dict[str, object], message: str) -> None:
    refused(message, Component, **{"count": 1, **arguments})


MESH = "embedded:torus/mesh.ply"


@pytest.mark.parametrize(
    ("kind", "name", "options", "message"),
    [
        ("background", "constant", {"rgb": [1.0]}, "give three"),
        ("background", "envmap", {"resolutions": []}, "give one or more"),
        ("background", "envmap", {"resolutions": [4, 0]}, r"resolutions=\[4, 0\] is not allowed; take at least 1"),
        ("data", "opencv", {"root": ".", "eval_crop": 0.0}, "eval_crop=0.0 is not allowed"),
        ("loss", "backdrop", {"colour": [1.0]}, "three numbers in"),
        ("loss", "photometric", {"ramp": -1}, "ramp=-1 is not allowed; take at least 0"),
        ("loss", "total_variation", {"angle": 0.0}, "more than 0 and less than 90"),
        ("medium", "voxel_grid", {"mesh": MESH, "box_max": [1.5, -2.0, 1.5]}, "min below max"),
        ("medium", "voxel_grid", {"mesh": MESH, "smoothing_size": 4}, "must be odd"),
        ("medium", "voxel_grid", {"mesh": MESH, "ior": -1.0}, "medium=voxel_grid: ior=-1.0 is not allowed"),
        ("sampler/path", "eikonal", {"tolerance": 0.0}, "tolerance=0.0 is not allowed; take more than 0"),
        ("sampler/path", "snell", {"least_weight": 1.0}, "least_weight"),
        ("sampler/path", "snell", {"wavelengths": [500.0, 600.0]}, "wavelengths"),
        ("sampler/points", "stratified", {"offset": 1.0}, "offset=1.0 is not allowed; take at least 0 and less than 1"),
        ("sampler/points", "stratified", {"cast": "cones", "draw": "vertices"}, "cones have no vertices to draw"),
    ],
)
def test_options_of_plugins_that_are_out_of_range_are_refused(
    kind: str, name: str, options: dict[str, object], message: str
) -> None:
    discover()
    refused(message, create, find(kind, name), options)


@pytest.mark.parametrize("box_max", [[1.0, 0.0, 1.0], [1.0, 1.0], [1.0, 1.0, math.nan], [1.0, 1.0, math.inf]])
def test_invalid_boxes_are_refused(box_max: list[float]) -> None:
    refused("is not a box; give three numbers each, min below max", corners_of_box, [0.0] * 3, box_max)
