"""Choice of the device of a training: `trainer.accelerator=auto` checks and times the GPU against the CPU."""

from __future__ import annotations

import contextlib
import copy
import json
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from nerfro.core.errors import NerfroError, one_line
from nerfro.core.paths import cache_dir
from nerfro.core.provenance import versions
from nerfro.files.atomic import write_atomically
from nerfro.files.cache import content_hash
from nerfro.files.reading import read_json
from nerfro.kernels.available import find_gpu, gpu_name
from nerfro.rendering import RayTracer
from nerfro.training.data_module import RayDataModule, can_prefetch
from nerfro.training.module import TrainingModule
from nerfro.training.settings import Role, settings
from nerfro.training.trainer import lightning_precision, one_process

# A step at which all losses have begun and all pixels that need several rays have them.
_STEP = 100_000
# Pixels of the step that is compared, and limits of the timed steps.
_NUM_PIXELS, _NUM_STEPS, _SECONDS = 256, 10, 5.0
# Largest differences between the devices, which round differently, also in bfloat16: relative difference of the loss,
# least cosine between the gradients, and difference of the radiance of 98 % of the rays. Rays at grazing incidence may
# take another way.
_LOSS, _COSINE, _RADIANCE = 0.02, 0.95, 0.02


class Compared(NamedTuple):
    """Result of a comparison of a GPU with the CPU.

    Attributes:
        difference: first difference in a step that exceeds the rounding of the devices; empty if there is none.
        gpu, cpu: milliseconds of a step; zero after a difference.
    """

    difference: str
    gpu: float = 0.0
    cpu: float = 0.0


def choose_accelerator(config: DictConfig, module: TrainingModule, data: RayDataModule) -> str:
    """Return `trainer.accelerator`, where `auto` becomes `gpu` if a GPU gives the results of the CPU in less time.

    The choice and its reason are printed in one line if there is a GPU. A comparison is remembered in the cache.

    Args:
        config: complete configuration of the run.
        module: module of the run, on the CPU.
        data: data of the run.
    """
    name, gpu = str(config.trainer.accelerator), find_gpu()
    if name != "auto" or gpu is None:
        return "cpu" if name == "auto" else name
    title, accelerator = gpu_name(gpu), "cpu"
    if not one_process(config):
        reason = "auto compares the devices of one process only; set trainer.accelerator=gpu for several GPUs"
    else:
        try:
            result, origin = _remembered(config, gpu, module, data)
        except (RuntimeError, TypeError, ValueError) as error:  # of a driver, a kernel or memory
            reason = f"a step on {title} fails: {type(error).__name__}: {str(error).partition(chr(10))[0]}"
        else:
            times = f"a step takes {result.gpu:.3g} ms on {title} and {result.cpu:.3g} ms on the CPU{origin}"
            reason = times if not result.difference else f"{result.difference} on {title}{origin}"
            accelerator = "gpu" if not result.difference and result.gpu < result.cpu else "cpu"
    print(one_line(f"nerfro: trains on the {accelerator.upper()}: {reason}"), flush=True)
    return accelerator


def _remembered(
    config: DictConfig, gpu: torch.device, module: TrainingModule, data: RayDataModule
) -> tuple[Compared, str]:
    """Compare the devices, unless the cache has the result for this device, driver, version and method."""
    driver = Path("/proc/driver/nvidia/version")
    method = json.dumps(settings(config, frozenset({Role.METHOD, Role.SCENE})), sort_keys=True, default=str)
    parts = gpu_name(gpu), driver.read_text() if driver.is_file() else "", torch.get_num_threads(), method
    key = content_hash(*parts, platform.platform(), json.dumps(versions(), sort_keys=True))
    file = cache_dir() / f"accelerator_{key}.json"
    with contextlib.suppress(NerfroError, OSError, TypeError):
        return Compared(**read_json(file, "the comparison is repeated")), f" (remembered in {file})"
    result = compare(module, data, gpu, lightning_precision(config))
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, json.dumps(result._asdict()))
    return result, ""


def compare(module: TrainingModule, data: RayDataModule, gpu: torch.device, precision: str) -> Compared:
    """Compare the results of a step of a few hundred pixels on two devices, and time steps of all pixels.

    The module does not change, because copies take the steps.
    """
    modules = {"cpu": copy.deepcopy(module), "gpu": copy.deepcopy(module).to(gpu)}
    with torch.random.fork_rng(devices=[]):
        loss, radiance, gradient = zip(*(one_step(copied, data, precision) for copied in modules.values()), strict=True)
        if not abs(loss[0] - loss[1]) <= _LOSS * abs(loss[0]):  # NaN is a difference as well
            return Compared(f"the loss of a step is {loss[1]:.5g} instead of {loss[0]:.5g}")
        if not (error := (radiance[0] - radiance[1]).abs().amax(-1).quantile(0.98).item()) <= _RADIANCE:
            return Compared(f"the radiance of rays differs by {error:.2g} from the CPU")
        if not (cosine := torch.cosine_similarity(gradient[0], gradient[1], dim=0).item()) >= _COSINE:
            return Compared(f"the gradient of a step differs from the CPU (cosine {cosine:.3f})")
        return Compared("", **{name: milliseconds(copied, data, precision) for name, copied in modules.items()})


def one_step(module: TrainingModule, data: RayDataModule, precision: str) -> tuple[float, Tensor, Tensor]:
    """Return the loss of a step, the radiance of its rays, and its gradient, on the CPU."""
    batches = data.batches.smaller(_NUM_PIXELS).to(module.device, module.dtype)  # type: ignore[arg-type]
    batch = RayTracer(module.renderer, data.subdivision).trace(batches.draw(_STEP))
    with _autocast(module.device, precision):
        renderings = module.renderer.render_batch(batch)
        loss = module.objective(renderings, batch, module.scene, _STEP).total
    loss.backward()
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in module.parameters() if p.requires_grad]
    return loss.item(), renderings[-1].radiance.detach().float().cpu(), parameters_to_vector(gradients).float().cpu()


def milliseconds(module: TrainingModule, data: RayDataModule, precision: str) -> float:
    """Measure the time of a step on the device of the module, without the optimizer.

    A thread traces one step ahead if possible, and then the longer part decides about the time.
    """
    batches, tracer = data.batches.to(module.device, module.dtype), RayTracer(module.renderer, data.subdivision)  # type: ignore[arg-type]
    tracing, rest, begun = 0.0, 0.0, time.perf_counter()
    number = 0
    for number in range(_NUM_STEPS + 1):
        if number == 1:  # the first step compiles kernels and allocates memory
            tracing, rest, begun = 0.0, 0.0, time.perf_counter()
        before = time.perf_counter()
        batch = tracer.trace(batches.draw(_STEP + number))
        between = time_of(module.device)
        with _autocast(module.device, precision):
            renderings = module.renderer.render_batch(batch)
            total = module.objective(renderings, batch, module.scene, _STEP + number).total
        total.backward()
        module.zero_grad()
        tracing, rest = tracing + between - before, rest + time_of(module.device) - between
        if number > 0 and time.perf_counter() - begun > _SECONDS:
            break
    return 1e3 * (max(tracing, rest) if can_prefetch(module.renderer) else tracing + rest) / max(number, 1)


def time_of(device: torch.device) -> float:
    """Return the time after the device has finished its work."""
    if device.type != "cpu":
        torch.get_device_module(device).synchronize()
    return time.perf_counter()


@contextlib.contextmanager
def _autocast(device: torch.device, precision: str) -> Iterator[None]:
    """Compute in the precision of the training, see `lightning_precision`."""
    if not precision.endswith("-mixed"):
        yield
        return
    with torch.autocast(device.type, torch.bfloat16 if precision.startswith("bf16") else torch.float16):
        yield
