"""Estimates of the memory of a run, and the refusal of runs that exceed the available memory."""

import math
import re
from pathlib import Path

import pytest
import torch

from nerfro.backgrounds.base import Background, ConstantBackground
from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.errors import NerfroError
from nerfro.kernels import available
from nerfro.kernels.available import available_bytes, require_bytes
from nerfro.media.base import Vacuum
from nerfro.models.refractive import RefractiveModel
from nerfro.paper.nerf import NerfField
from nerfro.rendering import Components, Renderer, memory
from nerfro.rendering.memory import require_memory
from nerfro.samplers.base import Straight
from nerfro.samplers.points.stratified import Stratified
from nerfro.testing import example_batch
from tests.conftest import refused
from tests.pretended_gpu import GPU, OnGpu, PretendedGpu


def model_of(width: int, background: Background | None = None) -> Renderer:
    def field() -> NerfField:
        return NerfField(width=width, depth=8, skip=4, view_width=8)

    parts = Vacuum(), Straight(), Stratified(8), field, background or ConstantBackground()
    return RefractiveModel(Components(*parts, chunk_size=256))


def test_saved_tensors_are_counted_and_grow_with_the_network() -> None:
    batch, samples, device = example_batch(), 8, torch.device("cpu")
    kept = [memory._kept_bytes(model_of(width), batch, device) for width in (64, 256)]
    # Each of eight layers keeps its activations of 4 bytes.
    assert kept[1] - kept[0] == pytest.approx(8 * samples * (256 - 64) * 4, rel=0.5)
    assert memory._kept_bytes(model_of(64), example_batch(4), device) == pytest.approx(kept[0], rel=0.1)


def test_tables_of_a_fine_background_are_not_counted_for_each_ray() -> None:
    skies, device = (EnvironmentMap([4, 8]), EnvironmentMap([4, 256])), torch.device("cpu")
    coarse, fine = (memory._kept_bytes(model_of(16, sky), example_batch(), device) for sky in skies)
    assert fine == pytest.approx(coarse, rel=0.1)


def test_run_that_exceeds_the_memory_is_refused_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_bytes", lambda: 1e6)
    message = r"needs about \d.* kB are for each ray: take a smaller batches\.size"
    refused(message, require_memory, model_of(16), example_batch(), torch.device("cpu"))
    monkeypatch.setattr(memory, "available_bytes", lambda: math.inf)
    assert "memory: about" in require_memory(model_of(16), example_batch(), torch.device("cpu"))


@pytest.mark.parametrize(
    ("limit", "free"), [("5000000\n", 5_000_000 - 3_000_000 + 1_000_000), ("max\n", math.inf), (None, math.inf)]
)
def test_limit_of_a_control_group_ignores_reclaimable_files(
    limit: str | None, free: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = available_bytes()
    (tmp_path / "memory.current").write_text("3000000\n")
    (tmp_path / "memory.stat").write_text("anon 5\ninactive_file 1000000\nactive_file 7\n")
    if limit is not None:
        (tmp_path / "memory.max").write_text(limit)
    monkeypatch.setattr(available, "_control_groups", lambda: iter([(tmp_path, "memory.max", "memory.current")]))
    assert 0 < system < math.inf
    assert available_bytes() == free if free < math.inf else available_bytes() > 1e8


def test_array_that_exceeds_the_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(available, "available_bytes", lambda: 2e9)
    require_bytes(1e9, "medium.resolution=100")
    refused(r"=900 needs about 3\.0 GB of memory, but 2\.0 GB are free", require_bytes, 3e9, "medium.resolution=900")


def needed_gigabytes(model: Renderer, monkeypatch: pytest.MonkeyPatch) -> float:
    monkeypatch.setattr(memory, "available_bytes", lambda: -1e12)
    # The resident memory of this process also falls, when objects of other tests are freed.
    resident = 1e9 + sum(parameter.nbytes for parameter in model.parameters())
    monkeypatch.setattr(memory, "number_in", lambda *_: resident)
    pattern = r"about ([\d.]+) GB"
    message = refused(pattern, require_memory, model, example_batch(), torch.device("cpu"))
    return float(re.search(pattern, message)[1])  # type: ignore[index]


def test_checkpoint_is_counted_with_weights_gradients_and_moments(monkeypatch: pytest.MonkeyPatch) -> None:
    small = needed_gigabytes(model_of(16), monkeypatch)
    model = model_of(2048)
    weights = sum(parameter.nbytes for parameter in model.parameters())
    # Weights, gradients and two moments, and the checkpoint, which holds all but the gradients.
    assert needed_gigabytes(model, monkeypatch) - small > 6.5 * weights / 1e9


def test_memory_of_a_gpu_is_compared_with_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    model, free = model_of(16), 1e9
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free, free))
    with PretendedGpu():
        assert "memory: about 0.0 GB of 1.0 GB" in require_memory(model, example_batch(), GPU)
        with pytest.raises(NerfroError, match=r"needs about \d+\.\d GB of cuda memory and 1\.0 GB are free"):
            require_memory(model, example_batch(), GPU, share=1e-6)
    assert all(isinstance(parameter, OnGpu) for parameter in model.parameters())
