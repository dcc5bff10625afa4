"""Every type of experiment on a simulated GPU: all tensors are there, and the host waits only at known places."""

import warnings

import pytest
from omegaconf import DictConfig

from nerfro.data.base import Views
from nerfro.evaluation.render_view import render_view
from nerfro.kernels.constants import constant
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

# Rays are traced on the CPU, and travel there and back.
TRACING = ("kernels/operators.py", "samplers/paths/compiled.py", "paper/compiled.py", "paper/eikonal.py")
TRACING += ("samplers/paths/snell.py", "samplers/paths/polylines.py")
TRACING += ("geometry/intersection.py", "media/bodies.py")

ADAPTIVE = ["sampler.path.integrator=adaptive", "sampler.path.max_steps=60", "sampler.points.draw=arc_length"]

# A constant is copied to the device once. Fields are asked for samples in the object alone, whose number must be known.
ONCE = "kernels/constants.py: constant (tensor)"
# Triangles are met on the CPU in a replay as well. Some rays are traced again with more vertices.
AGAIN = "core/rays.py: <lambda> (__getitem__)"
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
        (["paper_refractive", *ADAPTIVE], {ONCE, AGAIN}),
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
    constant.cache_clear()
    with PretendedGpu() as gpu, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*CUDA is not available.*")
        module.to(GPU)
        batches, cameras = PixelBatches(views, 8, config.batches.batching).to(GPU), views.cameras.to(GPU)
        gpu.waits.clear()
        batch = RayTracer(renderer).trace(batches.draw(STEP))
        loss = module.training_step(batch, 0)["loss"]
        loss.backward()
        renderer.point_sampler.update(list(renderer.scene.fields), batch.draws)
        assert {wait for wait in gpu.waits if not wait.startswith(TRACING)} == waits
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
    # 448 and 330 with torch 2.13.
    assert gpu.launches.count - of_batch <= 460
    assert of_batch <= 340
