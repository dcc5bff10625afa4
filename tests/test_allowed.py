"""Which values annotations allow: in constructors, in configurations, and how the others are refused."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

import pytest
from omegaconf import OmegaConf

from nerfro.allowed import AnyNumber, Count, NotNegative, Positive, Range, check_settings, checked, corners_of_box
from nerfro.errors import NerfroError


@checked("thing")
class Thing:
    def __init__(
        self,
        count: Count,
        rate: Annotated[float, Range(more_than=0, at_most=2)] = 1.0,
        radius: Positive | None = None,
        sizes: list[Count] = (),  # type: ignore[assignment]
        mode: Literal["fast", "exact"] = "fast",
        anything: AnyNumber = 0.0,
        finite: float = 0.0,
    ) -> None:
        self.count = count


def test_what_is_allowed_passes() -> None:
    assert Thing(1, rate=2, radius=None, sizes=[1, 2], mode="exact", anything=math.nan).count == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "thing: count=0 is not allowed; take at least 1"),
        ({"rate": 0}, "rate=0 is not allowed; take more than 0 and at most 2"),
        ({"rate": math.nan}, "rate=nan is not allowed"),
        ({"radius": math.inf}, "radius=inf is not allowed; take more than 0"),
        ({"sizes": [3, 0]}, r"sizes=\[3, 0\] is not allowed; take at least 1"),
        ({"finite": math.inf}, "finite=inf is not allowed; take a finite number"),
        ({"rate": 10**400}, "is not allowed; take more than 0"),
        ({"mode": "slow"}, "mode='slow' is not allowed; choose 'fast', 'exact'"),
    ],
)
def test_what_is_not_allowed_is_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(NerfroError, match=message):
        Thing(**{"count": 1, **arguments})  # type: ignore[arg-type]


@dataclass
class Inner:
    share: NotNegative = 0.5


@dataclass
class Outer:
    size: Count = 3
    inner: Inner = field(default_factory=Inner)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("size=0", "^size=0 is not allowed; take at least 1"),
        ("inner.share=.nan", r"^inner\.share=nan is not allowed; take at least 0"),
    ],
)
def test_setting_of_a_configuration_is_named_in_full(override: str, message: str) -> None:
    config = OmegaConf.structured(Outer)
    check_settings(config, Outer)
    config.merge_with_dotlist([override])
    with pytest.raises(NerfroError, match=message):
        check_settings(config, Outer)


@pytest.mark.parametrize("box_max", [[1.0, 0.0, 1.0], [1.0, 1.0], [1.0, 1.0, math.nan], [1.0, 1.0, math.inf]])
def test_what_is_no_box_is_refused(box_max: list[float]) -> None:
    with pytest.raises(NerfroError, match="is not a box; give three numbers each, min below max"):
        corners_of_box([0.0] * 3, box_max)
