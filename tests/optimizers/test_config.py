"""The schedule of the learning rate, the progress of a run, and groups of parameters."""

import copy
import itertools
import math
from datetime import timedelta
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Timer

from nerfro.losses.terms import BackgroundRegularizer
from nerfro.optimizers.config import GroupConfig, OptimizerConfig
from nerfro.registry.allowed import plain, validate
from nerfro.training.config import BatchesConfig, EvaluationConfig, TrainConfig
from nerfro.training.module import learning_rate_factor, training_progress
from tests.conftest import composed, refused

PAPER = OptimizerConfig(
    learning_rate=5e-4, final_learning_rate=5e-6, decay_start=0, warmup_steps=2500, warmup_factor=0.01
)


def rate(step: int, num_steps: int = 200_000) -> float:
    return PAPER.learning_rate * learning_rate_factor(step, step / num_steps, PAPER)


def test_learning_rate_at_the_beginning_the_end_of_the_warm_up_and_the_end() -> None:
    assert rate(0) == pytest.approx(0.01 * 5e-4)
    assert rate(2500) == pytest.approx(5e-4 * 0.01 ** (2500 / 200_000))
    assert rate(200_000) == pytest.approx(5e-6)


def test_decay_is_linear_in_the_logarithm() -> None:
    logarithms = [math.log(rate(step)) for step in range(10_000, 200_000, 10_000)]
    slopes = [b - a for a, b in itertools.pairwise(logarithms)]
    assert slopes == pytest.approx([math.log(0.01) / 20] * len(slopes))


def test_rate_is_constant_until_the_decay_starts() -> None:
    late = OptimizerConfig(learning_rate=1.0, final_learning_rate=1e-2, decay_start=0.6, warmup_steps=0)
    rates = [learning_rate_factor(1, progress, late) for progress in (0.0, 0.6, 0.8, 1.0)]
    assert rates == pytest.approx([1.0, 1.0, 0.1, 1e-2])


def test_warm_up_rises_as_a_quarter_of_a_sine() -> None:
    constant = OptimizerConfig(learning_rate=1.0, final_learning_rate=1.0, warmup_steps=100, warmup_factor=0.2)
    assert learning_rate_factor(50, 0.0, constant) == pytest.approx(0.2 + 0.8 * math.sin(math.pi / 4))
    assert learning_rate_factor(1000, 0.5, constant) == 1


def run(step: int, max_steps: int, timer: Timer | None = None) -> Any:
    return Mock(spec=Trainer, global_step=step, max_steps=max_steps, callbacks=[] if timer is None else [timer])


class StoppedClock(Timer):
    """A budget of which a given time is spent."""

    def __init__(self, budget: float, spent: float) -> None:
        super().__init__(duration=timedelta(seconds=budget))
        self._spent = spent

    def time_elapsed(self, stage: Any = None) -> float:
        return self._spent

    def time_remaining(self, stage: Any = None) -> float:
        return self._duration - self._spent


@pytest.mark.parametrize(
    ("step", "max_steps", "spent", "progress"),
    [
        *[(0, 200, None, 0.0), (50, 200, None, 0.25), (300, 200, None, 1.0)],  # by steps
        *[(10, -1, 0.0, 0.0), (10, -1, 15.0, 0.25), (10, -1, 61.0, 1.0)],  # by time
        *[(50, 200, 30.0, 0.5), (150, 200, 30.0, 0.75)],  # by the budget that ends first
        (1000, -1, None, 0.0),  # without a budget
    ],
)
def test_progress_is_the_used_fraction_of_the_budget(
    step: int, max_steps: int, spent: float | None, progress: float
) -> None:
    timer = None if spent is None else StoppedClock(60, spent)
    assert training_progress(run(step, max_steps, timer)) == pytest.approx(progress)


def test_last_matching_pattern_decides_and_unmatched_pattern_is_refused() -> None:
    names = ["fields.0.table", "background.texels", "bodies.glass.material.ior", "bodies.water.material.ior"]
    parameters = {name: torch.nn.Parameter(torch.tensor(float(i))) for i, name in enumerate(names)}

    def grouped(*patterns: str) -> dict[str, list[str]]:
        groups = OptimizerConfig(groups={pattern: GroupConfig() for pattern in patterns}).grouped(parameters)
        return {group: [names[int(parameter)] for parameter in own] for group, own in groups.items()}

    index, water = "bodies.*.material.ior", "bodies.water.*"
    assert grouped(index, water) == {"common": names[:2], index: [names[2]], water: [names[3]]}
    assert grouped(water, index) == {"common": names[:2], index: names[2:]}
    assert grouped("bodies.*.material.absorption") == {"common": names}, "a group of an experiment may be absent"
    refused(r"bodies\.glas\.\* matches no .*choose from .*bodies\.glass\.material\.ior", grouped, "bodies.glas.*")


def test_groups_with_several_kinds_of_optimizers_step_like_each_alone_and_resume() -> None:
    config = OptimizerConfig(
        learning_rate=0.1, adam_beta=0.9, groups={"b": GroupConfig(0.5, name="sgd"), "c": GroupConfig(name="radam")}
    )
    adam = {"eps": config.adam_epsilon, "betas": (0.9, config.adam_beta)}
    kinds = {"a": torch.optim.Adam, "b": torch.optim.SGD, "c": torch.optim.RAdam}

    def start() -> tuple[dict[str, torch.nn.Parameter], torch.optim.Optimizer]:
        parameters = {name: torch.nn.Parameter(torch.ones(2)) for name in kinds}
        return parameters, config.optimizer_of(config.grouped(parameters), fused=False)

    def step(parameters: dict[str, torch.nn.Parameter], *optimizers: torch.optim.Optimizer) -> None:
        for parameter in parameters.values():
            parameter.grad = parameter.detach() ** 2
        for optimizer in optimizers:
            optimizer.step()

    (joint, optimizer), (alone, _) = start(), start()
    separate = [
        kind([alone[name]], lr=0.5 if name == "b" else 0.1, **({} if name == "b" else adam))
        for name, kind in kinds.items()
    ]
    for _ in range(3):
        step(joint, optimizer)
        step(alone, *separate)
    resumed, again = start()
    again.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    with torch.no_grad():
        for name, parameter in resumed.items():
            parameter.copy_(joint[name])
    step(resumed, again)
    step(alone, *separate)
    for name, parameter in resumed.items():
        assert torch.equal(parameter, alone[name]), name


@pytest.mark.skipif(not hasattr(torch.optim, "Muon"), reason="needs torch 2.9")
def test_muon_learns_the_matrices_of_a_group_and_refuses_other_parameters() -> None:
    parameters = {"fields.0.mlp.weight": torch.nn.Parameter(torch.ones(3, 2)), "b": torch.nn.Parameter(torch.ones(2))}
    config = OptimizerConfig(groups={"fields.*.weight": GroupConfig(name="muon")})
    optimizer = config.optimizer_of(config.grouped(parameters), fused=False)
    for parameter in parameters.values():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    assert all(bool((parameter < 1).all()) for parameter in parameters.values())
    assert optimizer.state[parameters["fields.0.mlp.weight"]].keys() == {"momentum_buffer"}
    config = OptimizerConfig(name="muon", groups={})
    refused("takes matrices only", config.optimizer_of, config.grouped(parameters), fused=False)


def test_frozen_parameters_have_no_gradient_and_no_group() -> None:
    parameters = {name: torch.nn.Parameter(torch.ones(2)) for name in ("fields.0.table", "background.texels")}
    config = OptimizerConfig(freeze=["fields.*"])
    config.freeze_parameters(parameters)
    assert [parameter.requires_grad for parameter in parameters.values()] == [False, True]
    assert list(config.grouped(parameters)) == ["background.*"]
    refused(
        r"optimizer\.freeze: feilds\.\* matches no", OptimizerConfig(freeze=["feilds.*"]).freeze_parameters, parameters
    )
    refused("leaves no parameter to learn", OptimizerConfig(freeze=["*"]).freeze_parameters, parameters)


def test_defaults_of_python_and_of_the_command_are_the_same() -> None:
    config = validate(TrainConfig, plain(composed()), complete=False)
    assert config.optimizer == OptimizerConfig()
    assert (config.batches, config.evaluation) == (BatchesConfig(), EvaluationConfig())
    assert OptimizerConfig().warmup_steps == 20
    regularizer = composed().loss.background
    assert {name: getattr(BackgroundRegularizer(), name) for name in regularizer if name != "_target_"} == {
        name: value for name, value in regularizer.items() if name != "_target_"
    }
