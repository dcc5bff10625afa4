"""Kernels share a process with other threads and with other users of Numba."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from nerfro.kernels import compilation
from tests.processes import printed_by

IMPORTS_ONLY = """
import numba
before = {name: value for name, value in vars(numba.config).items() if name.isupper()}
import nerfro.backgrounds.cube_map, nerfro.geometry.occupancy, nerfro.samplers.paths.snell_cpu
after = {name: value for name, value in vars(numba.config).items() if name.isupper()}
print({name: after[name] for name in after if before.get(name) != after[name]})
try:
    print(numba.threading_layer())
except ValueError:
    print("no threads")
"""

TWO_THREADS = """
import threading, numba, torch
from nerfro.samplers.paths.snell import Snell
from nerfro.core.types import Rays
from tests.closed_forms import sampled

torch.set_num_threads(2)
axis = torch.linspace(-1.5, 1.5, 16)
distances = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).norm(dim=-1) - 0.8
ball = sampled(distances[None], torch.tensor([[-1.5] * 3, [1.5] * 3]), [1.5], 0.01)
directions = torch.nn.functional.normalize(torch.rand(500, 3) - 0.5, dim=-1)
one = torch.ones(500)
rays = Rays(-4 * directions.roll(1, 1) * 0.1 - 4 * directions, directions, 0 * one, 2 * one, 6 * one)
expected = Snell()(rays, ball).positions
same = []

def trace():
    same.extend(torch.equal(Snell()(rays, ball).positions, expected) for _ in range(200))

threads = [threading.Thread(target=trace) for _ in range(2)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(len(same), all(same), numba.threading_layer(), numba.config.THREADING_LAYER)
"""


def test_importing_kernels_does_not_change_settings_of_numba() -> None:
    assert printed_by("-c", IMPORTS_ONLY, NUMBA_NUM_THREADS="2") == "{}\nno threads\n"


@pytest.mark.slow
@pytest.mark.parametrize(("chosen", "used"), [("default", "workqueue"), ("omp", "omp")])
def test_two_threads_may_trace_concurrently_on_the_chosen_threading_layer(chosen: str, used: str) -> None:
    printed = printed_by("-c", TWO_THREADS, NUMBA_NUM_THREADS="2", NUMBA_THREADING_LAYER=chosen)
    assert printed == f"400 True {used} {chosen}\n"


@pytest.mark.parametrize("busy", [True, False])
def test_idle_thread_takes_tasks(busy: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    both_threads, end = threading.Barrier(2), threading.Event()

    def name(number: int) -> str:
        if not busy:
            both_threads.wait(10)  # passes only if two threads call the function at the same time
        return f"{number} {threading.current_thread() is threading.main_thread()}"

    with ThreadPoolExecutor(1) as helper:
        monkeypatch.setattr(compilation, "HELPERS", [helper])
        if busy:
            helper.submit(end.wait, 10)
        names = compilation.share(name, 6)
        end.set()
    assert [called.split()[0] for called in names] == [*"012345"]
    assert {called.split()[1] for called in names} == {"True"} | ({"False"} if not busy else set())


def test_error_of_a_helping_thread_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    both_threads = threading.Barrier(2)

    def fail(number: int) -> None:
        both_threads.wait(10)
        if threading.current_thread() is not threading.main_thread():
            raise ValueError("no helper")

    with ThreadPoolExecutor(1) as helper:
        monkeypatch.setattr(compilation, "HELPERS", [helper])
        with pytest.raises(ValueError, match="no helper"):
            compilation.share(fail, 2)


def test_helping_threads_write_to_inference_tensors(monkeypatch: pytest.MonkeyPatch) -> None:
    both_threads = threading.Barrier(2)
    with ThreadPoolExecutor(1) as helper, torch.inference_mode():
        monkeypatch.setattr(compilation, "HELPERS", [helper])
        values = torch.zeros(2)

        def write(number: int) -> None:
            both_threads.wait(10)
            values[number] = 1.0

        compilation.share(write, 2)
    assert values.tolist() == [1.0, 1.0]
