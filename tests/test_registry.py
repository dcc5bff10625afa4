"""The registry and the typed configuration: accepted values, annotations, and errors for other values."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

import pytest
from annotated_types import Gt, Le
from omegaconf import OmegaConf
from torch import nn

import nerfro.registry.registration
from nerfro.core.errors import NerfroError
from nerfro.geometry.space import corners_of_box
from nerfro.registry.allowed import Count, Positive, validated
from nerfro.registry.registration import build, configure, create, discover, find, register
from nerfro.training.config import build_each
from tests.conftest import Runner, refused

discover()


@pytest.fixture(autouse=True)
def _registry_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Registrations of a test end with it."""
    monkeypatch.setattr(nerfro.registry.registration, "_plugins", dict(nerfro.registry.registration._plugins))


# What a constructor becomes.


def test_constructor_becomes_the_configuration() -> None:
    @register("background", "of_test")
    class OfTest(nn.Module):
        """First line.

        More.
        """

        def __init__(
            self,
            medium: nn.Module,
            required: int,
            rate: float = 0.5,
            names: tuple[str, ...] = ("a",),
            maybe: Optional[int] = None,  # noqa: UP045 - the older spelling too
            newer: str | None = None,
            mode: Literal["fast", "exact"] = "fast",
        ) -> None:
            super().__init__()
            self.arguments = required, rate, names, maybe, newer, mode
            self.medium = medium

    plugin = find("background", "of_test")
    assert plugin.parts == {"medium"}
    assert plugin.summary == "First line."
    assert list(plugin.fields()) == [
        ("required", "int", "required"),
        ("rate", "float", 0.5),
        ("names", "list of str", ["a"]),
        ("maybe", "int; or null", None),
        ("newer", "str; or null", None),
        ("mode", "`fast`, `exact`", "fast"),
    ]
    medium = nn.Identity()
    built = build({"_target_": plugin.target, "required": 3}, medium=medium, something_else=1)
    assert built.arguments == (3, 0.5, ("a",), None, None, "fast")
    assert built.medium is medium


def test_integer_is_accepted_as_float_and_digits_as_integer() -> None:
    plugin = find("loss", "background")
    assert configure(plugin, {"weight": 1, "start": "7"})["weight"] == 1.0
    assert configure(plugin, {"weight": 1, "start": "7"})["start"] == 7


# Refusals by the registry.


def test_constructor_with_arbitrary_arguments_is_refused() -> None:
    with pytest.raises(NerfroError, match=r"takes \*options; name every parameter instead"):

        @register("background", "greedy")
        class Greedy(nn.Module):
            """Takes anything."""

            def __init__(self, **options: float) -> None:
                super().__init__()


def test_missing_required_field_is_named() -> None:
    refused(r"data=opencv needs root; add data\.root=\.\.\.", configure, find("data", "opencv"), {})


@pytest.mark.parametrize(
    ("target", "advice"),
    [
        ("os.system", "; .*nerfro.plugins"),
        (None, "; .*nerfro.plugins"),
        (
            "nerfro.paper.eikonal.march_uniform",
            " in this version of nerfro; for a run of another version, .*train again",
        ),
    ],
)
def test_target_that_is_not_registered_is_not_built(target: str | None, advice: str, tmp_path: Path) -> None:
    node = {"_target_": target, "command": f"touch {tmp_path / 'ran'}"}
    refused(f"'{target}' is not registered{advice}", build, node)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("target", ["os.system", "${name}"])
@pytest.mark.parametrize("nested", ["strategy", "plugins"])
def test_target_inside_a_lightning_object_is_not_built(nested: str, target: str, tmp_path: Path) -> None:
    node: dict[str, Any] = {"_target_": target, "command": f"touch {tmp_path / 'ran'}"}
    trainer = {"_target_": "lightning.pytorch.Trainer", nested: node if nested == "strategy" else [node]}
    config = OmegaConf.create({"name": "os.system", "trainer": trainer})
    refused(r"'os\.system' inside lightning\.pytorch\.Trainer is not registered", build, config.trainer)
    assert not (tmp_path / "ran").exists()


def test_unknown_field_of_a_lightning_object_is_refused() -> None:
    with pytest.raises(NerfroError, match=r"lightning\.pytorch\.Trainer: .*'max_step'.*; check this object's fields"):
        build({"_target_": "lightning.pytorch.Trainer", "max_step": 3})


@pytest.mark.parametrize(
    ("losses", "message"),
    [
        (
            {"photometric": {"weigth": 1}},
            r"loss\.photometric\.weigth is not a setting; did you mean weight\?",
        ),
        (
            {"photometric": 3},
            r"loss\.photometric=3 is not a set of settings; .*write loss\.photometric\.weight=3",
        ),
        ({}, r"there is no loss to train with; add one, such as \+loss\.photometric\.weight=1"),
    ],
)
def test_wrong_losses_are_refused(losses: dict[str, object], message: str) -> None:
    refused(message, build_each, "loss", OmegaConf.create(losses))


# Refusals in an experiment file.


@pytest.mark.parametrize(
    ("experiment", "words"),
    [
        ("nmae: x", ["In 'experiment/of_test'", "nmae is not a setting; did you mean name?"]),
        ("optimizer: {lerning_rate: 3}", ["optimizer.lerning_rate is not a setting; did you mean learning_rate?"]),
        ("defaults: [{override /model: nrf}]", ["Could not find 'model/nrf'"]),
        ("trainer: {strategy: {_target_: os.system, command: 'false'}}", ["'os.system' inside lightning"]),
    ],
)
def test_mistake_in_an_experiment_file_gives_a_one_line_error(
    experiment: str, words: list[str], train: Runner, tmp_path: Path
) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "of_test.yaml").write_text(f"# @package _global_\n{experiment}\n")
    refused = train("+experiment=of_test", f"hydra.searchpath=[file://{tmp_path}]", code=1)
    for word in words:
        assert word in refused.error
    assert "nerfro:" not in refused.out, "nothing has started"
    assert not list((tmp_path / "run").rglob("*")), "nothing is written"


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
        ({"radius": math.inf}, "radius=inf is not allowed; take a finite number, more than 0"),
        ({"sizes": [3, 0]}, r"sizes=\[3, 0\] is not allowed; take at least 1"),
        ({"finite": math.inf}, "finite=inf is not allowed; take a finite number"),
        ({"rate": 10**400}, "is not allowed; take a finite number, more than 0 and at most 2"),
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
