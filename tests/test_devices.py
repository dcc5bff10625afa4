"""Every type of experiment on a simulated GPU: all tensors are there, and the host waits only at known places."""

import copy
import dataclasses
import itertools
import warnings

import pytest
import torch
from omegaconf import DictConfig

from nerfro.core.transfer import transfer
from nerfro.core.types import Exits
from nerfro.data.base import Views
from nerfro.evaluation.render_view import render_view
from nerfro.kernels.constants import cached_constant
from nerfro.media.bodies import Bodies
from nerfro.registry.registration import build
from nerfro.rendering import RayTracer
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.config import build_medium, build_model
from nerfro.training.derivation import derived
from nerfro.training.module import TrainingModule
from nerfro.training.pixel_batches import PixelBatches
from nerfro.viewing.baking import bake_surface
from tests.conftest import composed
from tests.pretended_gpu import GPU, OnGpu, PretendedGpu
from tests.test_experiments import SMALL, shrunk

# A step at which all losses have begun and densities are looked at.
STEP = 100_000

ADAPTIVE = ["sampler.path.integrator=adaptive", "sampler.path.max_steps=60", "sampler.points.draw=arc_length"]

# A constant is copied to the device once. Fields are asked for samples in the object alone, whose number must be known.
ONCE = "kernels/constants.py: _constant (tensor)"
SELECTED = "fields/base.py: evaluate_selected (nonzero)"


def small_module(experiment: list[str], monkeypatch: pytest.MonkeyPatch) -> tuple[TrainingModule, Views, DictConfig]:
    """Return a module at step `STEP`, with its training views and its configuration."""
    monkeypatch.setattr(TrainingModule, "log", lambda *values, **options: None)
    monkeypatch.setattr(TrainingModule, "global_step", STEP)
    overrides = [f"+experiment={experiment[0]}", *experiment[1:], *SMALL, "data.downscale=16"]
    config = composed(*overrides, *shrunk(composed(*overrides)))
    views = build(config.data).load("train")
    config = derived(config, build_medium(config), views)
    return TrainingModule.of(build_model(config), config), views, config


@pytest.mark.parametrize(
    ("experiment", "waits"),
    [
        (["refractive"], {ONCE, SELECTED}),
        (["refractive", "sampler.path.interface=mesh"], {ONCE, SELECTED}),
        (["refractive_room"], {ONCE}),
        (["straight"], {ONCE}),
        (["mipnerf"], set()),
        (["paper_refractive"], set()),
        (["paper_refractive", *ADAPTIVE], set()),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_training_and_rendering_stay_on_the_gpu(
    experiment: list[str], waits: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    module, views, config = small_module(experiment, monkeypatch)
    renderer = module.renderer
    # What is computed and kept while the model is on the CPU must move with it.
    renderer.render(views.cameras.image_rays(0))
    cached_constant.cache_clear()
    with PretendedGpu() as gpu, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*CUDA is not available.*")
        module.to(GPU)
        batches, cameras = PixelBatches(views, 8, config.batches.batching).to(GPU), views.cameras.to(GPU)
        tracer = RayTracer(renderer)
        tracer.trace(batches.draw(STEP - 1))  # copies medium and samplers to the CPU
        gpu.waits.clear()
        batch = tracer.trace(batches.draw(STEP))
        loss = module.training_step(batch, 0)["loss"]
        loss.backward()
        renderer.point_sampler.update(list(renderer.scene.fields), batch.draws)
        assert gpu.waits == waits
        rendered = render_view(renderer, cameras, 0, Subdivision())
        if isinstance(renderer.scene.medium, Bodies):
            assert bake_surface(renderer).voxels
    assert isinstance(loss, OnGpu)
    assert isinstance(rendered.radiance, OnGpu)
    assert all(isinstance(tensor, OnGpu) for tensor in (*module.parameters(), *module.buffers()))
    assert all(parameter.grad is not None for parameter in module.parameters())


def test_step_on_a_gpu_launches_few_operators(monkeypatch: pytest.MonkeyPatch) -> None:
    module, views, config = small_module(["refractive"], monkeypatch)
    module.is_logged_step = False
    with PretendedGpu() as gpu, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*CUDA is not available.*")
        batches = PixelBatches(views, 8, config.batches.batching).to(GPU)
        tracer = RayTracer(module.to(GPU).renderer)
        for _ in range(2):  # the first step makes constants
            gpu.launches.count = 0
            batch = tracer.trace(batches.draw(STEP))
            of_batch = gpu.launches.count
            module.training_step(batch, 0)["loss"].backward()
    # 428 with torch 2.13.
    assert gpu.launches.count - of_batch <= 440
    assert of_batch == 1, "one copy"


@pytest.mark.parametrize("learned", [False, True], ids=["kernels trace", "paths learn"])
def test_batches_of_a_gpu_are_those_of_the_cpu(learned: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also after cameras and density grid have changed or been replaced. PyTorch samples learned paths, and rounds."""
    options = ["camera=refined", f"medium.learn_ior={learned}"]
    module, views, config = small_module(["refractive", *options], monkeypatch)
    module.scene.begin(views.cameras)
    batches, subdivision = PixelBatches(views, 8, config.batches.batching), Subdivision(2, 8.0, 0.05)

    def two_batches(batches: PixelBatches) -> list[list[torch.Tensor]]:
        own = copy.deepcopy(module) if batches.cameras.device.type == "cpu" else module.to(GPU)
        tracer, tensors, sampler = RayTracer(own.renderer, subdivision), [], own.renderer.point_sampler
        for step in (STEP, STEP + 1, STEP + 2):
            tensors.append(tensors_of(tracer.trace(batches.draw(step))))
            own.scene.camera.motion.add_(0.5)  # type: ignore[operator, union-attr]
            if step == STEP:
                sampler.density[8:].add_(5.0)  # type: ignore[operator, index]
            else:
                sampler.density = sampler.density + 5.0  # type: ignore[operator]
        return tensors

    expected = two_batches(batches)
    with PretendedGpu(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*CUDA is not available.*")
        of_gpu = two_batches(batches.to(GPU))
    for there, here in zip(itertools.chain(*of_gpu), itertools.chain(*expected), strict=True):
        assert isinstance(there, OnGpu)
        tolerance = 1e-4 if learned else 0.0
        torch.testing.assert_close(there.as_subclass(torch.Tensor), here, rtol=tolerance, atol=tolerance)
    pairs = zip(*expected[:2], strict=True)
    assert any(not torch.equal(one, other) for one, other in pairs if one.shape == other.shape)


def tensors_of(value: object) -> list[torch.Tensor]:
    """Return the tensors of a batch and of its parts."""
    if isinstance(value, torch.Tensor):
        return [value]
    parts = vars(value) if dataclasses.is_dataclass(value) else value if isinstance(value, dict) else {}
    return [tensor for part in parts.values() for tensor in tensors_of(part)]


def test_tensors_are_sent_in_one_copy() -> None:
    shared, zero = torch.arange(5.0), torch.zeros(())
    sent = {
        "bits": torch.tensor([True, False, True]), "number": torch.tensor(7), "none": torch.zeros(0, 3),
        "expanded": zero.expand(4, 3), "strided": torch.arange(12).view(3, 4).T, "text": "text",
        "exits": Exits(torch.rand(5, 3), None, shared), "shared": shared, "small": torch.tensor([-1], dtype=torch.int8),
    }  # fmt: skip
    with PretendedGpu() as gpu:
        arrived = transfer(sent, GPU)
        assert gpu.launches.count == 1
        assert transfer(arrived, GPU) is arrived
    assert arrived["exits"].radii is arrived["shared"]
    assert arrived["expanded"].stride() == (0, 0)
    assert arrived["text"] == "text"
    for name, tensor in sent.items():
        if isinstance(tensor, torch.Tensor):
            assert isinstance(arrived[name], OnGpu)
            assert torch.equal(arrived[name].as_subclass(torch.Tensor), tensor)
            assert arrived[name].dtype == tensor.dtype
