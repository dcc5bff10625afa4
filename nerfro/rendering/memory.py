"""Estimate of the memory of a run before training."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from nerfro.core.draws import Draws
from nerfro.core.errors import NerfroError
from nerfro.core.types import Batch
from nerfro.kernels.available import available_bytes, number_in
from nerfro.rendering.renderer import Renderer

# Peak memory of a training step and of an evaluation, relative to the tensors that autograd saves for the same rays.
_STEP, _EVALUATION = 2.0, 0.5


def require_memory(renderer: Renderer, batch: Batch, device: torch.device, share: float = 1.0) -> str:
    """Estimate the peak memory of a run, and refuse runs without enough memory.

    A few rays are rendered on the device, and the bytes that autograd keeps of them are counted. They grow with the
    number of rays and dominate the total.

    Args:
        renderer: moved to `device`, because the implementations for different devices keep different tensors.
        batch: part of a training batch.
        device: training device.
        share: fraction of the rays of a training batch that are in `batch`.

    Returns:
        The estimate in one line.

    Raises:
        NerfroError: the run needs more memory than is free.
    """
    renderer.to(device)
    kept = _kept_bytes(renderer, batch, device)
    learned = sum(p.nbytes for p in renderer.parameters() if p.requires_grad)
    num_rays = len(batch.rays) / share
    # Gradients and the two moments of Adam, in addition to the weights.
    step = 3 * learned + kept * max(_STEP * num_rays, _EVALUATION * renderer.chunk_size)
    # A checkpoint is built in main memory before it is written: the state, and the moments. Another 250 MB are for
    # compiled kernels, programs of matrix products, logging and metrics, and fragmentation.
    host = 250e6 + sum(tensor.nbytes for tensor in renderer.state_dict().values()) + 2 * learned
    per_ray = f"{kept / 1e3:.0f} kB"
    advice = f"{per_ray} are for each ray: take a smaller batches.size or evaluation.chunk_size"
    if device.type == "cuda":
        _require(host, available_bytes(), "main", "use a machine with more memory")
        needed, free = step, float(torch.cuda.mem_get_info(device)[0])
    else:
        resident = number_in(Path("/proc/self/status"), r"VmRSS:\s+(\d+)", 1024)
        needed, free = step + host + resident, available_bytes() + resident
    _require(needed, free, device.type, advice)
    of = "" if free == math.inf else f" of {free / 1e9:.1f} GB that are free"
    return f"memory: about {needed / 1e9:.1f} GB{of}, {per_ray} of it for each of {num_rays:.0f} rays a step"


def _require(needed: float, free: float, where: str, advice: str) -> None:
    if needed > free:
        raise NerfroError(
            f"the run needs about {needed / 1e9:.1f} GB of {where} memory and {max(free, 0) / 1e9:.1f} GB are free; "
            f"{advice}"
        )


def _kept_bytes(renderer: Renderer, batch: Batch, device: torch.device) -> float:
    """Count the bytes per ray saved by autograd for the backward pass, without parameters and buffers."""
    of_model = {tensor.untyped_storage().data_ptr() for tensor in (*renderer.parameters(), *renderer.buffers())}
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in of_model:
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    rays = batch.rays[:: max(len(batch.rays) // 128, 1)].to(device)
    every = torch.arange(len(rays), device=device)
    no_view, draws = torch.zeros_like(every), Draws(0, 0, every)
    probed = Batch(rays, every, every, no_view, torch.zeros_like(rays.origins), every >= 0, batch.cameras, draws)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        renderings = renderer.render_batch(probed)  # saved tensors stay alive, so that no address occurs twice
        del renderings
    return sum(kept.values()) / len(rays)
