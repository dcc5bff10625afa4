"""Options of `nerfro.synthesize`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Optional

from annotated_types import Ge, Le
from omegaconf import MISSING

from nerfro.registry.allowed import Count, Names, Natural, NotNegative, Positive
from nerfro.synthetic.scenes import SCENES

SceneName = Annotated[str, Names(lambda: SCENES)]


@dataclass
class ViewCounts:
    """Number of views per split."""

    train: Count = MISSING  # number of training views
    val: Count = MISSING  # number of validation views
    test: Count = MISSING  # number of test views


@dataclass
class SynthesizeConfig:
    """Options of `nerfro.synthesize`; conf/synthesize/synthesize.yaml gives and explains the defaults."""

    scene: SceneName = MISSING
    out: str = MISSING
    resolution: Annotated[int, Ge(8), Le(16384)] = MISSING
    spp: Count = MISSING
    test_spp: Count = MISSING
    views: ViewCounts = field(default_factory=ViewCounts)
    photographs: Count = MISSING
    noise: NotNegative = MISSING
    fresnel: bool = MISSING
    absorption: list[NotNegative] = MISSING
    ior: Optional[Positive] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    seed: Natural = MISSING
    sky_height: Annotated[int, Ge(16), Le(16384)] = MISSING
    extras: bool = MISSING
    variant: str = MISSING
    overwrite: bool = MISSING
