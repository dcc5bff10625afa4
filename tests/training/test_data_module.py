"""Prefetched batches equal the batches of their steps, and errors of the thread are raised."""

import threading
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from nerfro.core.draws import Draws
from nerfro.kernels import compilation
from nerfro.media.bodies import Bodies
from nerfro.paper.eikonal import Eikonal
from nerfro.rendering import Renderer, Scene
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.testing import example_space
from nerfro.training.data_module import Prefetcher, can_prefetch, multiplies_large_matrices
from tests.closed_forms import grid_points, random_rays, sampled
from tests.conftest import Runner, weights_of


@pytest.fixture(scope="module")
def ball() -> Bodies:
    points = grid_points(1.5, 40)
    box = torch.tensor([[-1.5] * 3, [1.5] * 3])
    return sampled(points.norm(dim=-1)[None] - 0.8, box, [1.5], 0.01)


def running() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("helper")]


@pytest.fixture
def ahead():
    """Makes an Prefetcher and ends its thread."""
    made: list[Prefetcher] = []

    def make(function) -> Prefetcher:
        made.append(Prefetcher(function))
        return made[-1]

    yield make
    for one in made:
        one.close()
    assert not running()


def test_next_batch_is_made_during_the_step(ahead) -> None:
    begun = threading.Event()
    one = ahead(lambda step: begun.set() if step == 1 else None)
    one(0)
    one.begin_next()
    assert begun.wait(10), "nobody has asked for step 1 yet"


def test_prefetched_paths_equal_those_of_the_step_in_any_order(ahead, ball: Bodies) -> None:
    sampler = Snell()
    make: Any = lambda step: sampler(random_rays(300, 1.6, step, 6.0), ball)  # noqa: E731
    one = ahead(make)
    for step in (0, 1, 7, 3):
        expected, path = make(step), one(step)
        one.begin_next()
        for name in ("positions", "directions", "s", "exit_directions"):
            assert torch.equal(getattr(path, name), getattr(expected, name))


def test_prefetcher_reraises_errors_of_its_thread(ahead) -> None:
    def make(step: int) -> int:
        if step == 2:
            raise ValueError("no rays")
        return step

    one = ahead(make)
    assert [one(0), one(1)] == [0, 1]
    one.begin_next()
    with pytest.raises(ValueError, match="no rays"):
        one(2)


@pytest.mark.parametrize(("width", "helpers", "of_torch"), [(8, 2, 1), (512, 1, 3)])
def test_threads_share_a_step_unless_matrices_are_large(width: int, helpers: int, of_torch: int) -> None:
    threads, renderer = torch.get_num_threads(), Mock(spec=Renderer, modules=lambda: [torch.nn.Linear(width, width)])
    try:
        torch.set_num_threads(3)
        prefetcher = Prefetcher(
            lambda step: (torch.get_num_threads(), torch.is_grad_enabled()),
            shares_steps=not multiplies_large_matrices(renderer),
        )
        assert prefetcher(0) == (1, False)
        assert (len(compilation.HELPERS), torch.get_num_threads()) == (helpers, of_torch)
        prefetcher.close()
        assert (len(compilation.HELPERS), torch.get_num_threads()) == (0, 3)
    finally:
        torch.set_num_threads(threads)


def test_batches_do_not_depend_on_the_number_of_threads(ahead, ball: Bodies) -> None:
    """Parts of rays and of polylines are traced and sampled in different threads."""
    rays, sampler = random_rays(301, 1.6, 0, 6.0), Snell(branches="all", least_weight=0.02)
    points = DensityGridSampler(example_space())

    def batch(step: int) -> tuple[torch.Tensor, ...]:
        path = sampler(rays, ball)
        samples = points.choose_ahead(path, Draws(7, step, torch.arange(len(rays))))
        return path.positions, path.s, path.throughput, samples.positions, samples.edges

    alone, threads = batch(0), torch.get_num_threads()
    try:
        torch.set_num_threads(4)
        assert all(map(torch.equal, ahead(batch)(0), alone))
    finally:
        torch.set_num_threads(threads)


def test_paths_are_not_prefetched_if_they_learn_or_need_python(ball: Bodies, monkeypatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0, 1}, raising=False)

    def model(path_sampler, learns: bool = False) -> Any:
        renderer = Mock(
            spec=Renderer, path_sampler=path_sampler, scene=Mock(spec=Scene, medium=ball), paths_learn=learns
        )
        renderer.traces_on_cpu = Renderer.traces_on_cpu.fget(renderer)  # type: ignore[attr-defined]
        return renderer

    assert can_prefetch(model(Snell()))
    assert not can_prefetch(model(Snell(), learns=True))
    assert not can_prefetch(model(Eikonal("euler")))
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0}, raising=False)
    assert not can_prefetch(model(Snell())), "one core has nobody who waits"


def test_weights_depend_neither_on_the_thread_nor_on_an_interruption(
    train: Runner, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The thread chooses samples by the density grid, which changes in every second step here."""

    def weights(name: str, cores: set[int], *overrides: str) -> dict[str, torch.Tensor]:
        monkeypatch.setattr("os.sched_getaffinity", lambda pid: cores, raising=False)
        # A batch that is begun before the update is finished before the update.
        monkeypatch.setattr(DensityGridSampler, "update", lambda *given: time.sleep(0.05) or update(*given))
        even = ["optimizer.learning_rate=1e-2", "optimizer.final_learning_rate=1e-2"]
        options = [*even, "evaluation=none", "trainer.max_steps=7", "sampler.points.update_every=2", *overrides]
        train(*options, f"hydra.run.dir={tmp_path / name}")
        return weights_of(tmp_path / name)

    update = DensityGridSampler.update
    expected = weights("one core", {0})
    weights("resumed", {0, 1}, "trainer.max_steps=4")
    for found in (weights("two cores", {0, 1}), weights("resumed", {0, 1}, "ckpt_path=last")):
        assert [name for name, value in expected.items() if not torch.equal(found[name], value)] == []
    assert any(name.endswith("point_sampler.density") and value.any() for name, value in expected.items())


def test_no_batch_is_made_ahead_if_paths_learn(train: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0, 1}, raising=False)
    monkeypatch.setattr(Prefetcher, "__init__", lambda *_: pytest.fail("a thread makes batches"))
    train("trainer.max_steps=2", "evaluation=none", "medium.learn_ior=true")
