"""What a run needs of the memory that there is, told before it starts."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from nerfro.draws import Draws
from nerfro.errors import NerfroError
from nerfro.kernels.available import available_bytes, number_in
from nerfro.rays import Rays
from nerfro.rendering import Renderer

_PROBED_RAYS = 128
# Of what autograd keeps of as many rays: a step with its backward pass, and an evaluation, in which nothing is kept.
_STEP, _EVALUATION = 2.0, 0.5
# Compiled kernels, matrix products' programs, what logging and metrics load, and gaps between blocks.
_LATER_BYTES = 250e6


def require_memory(renderer: Renderer, rays: Rays, device: torch.device, share: float = 1.0) -> str:
    """What a run will need at most, in one line.

    A few rays are rendered, and what autograd keeps of them is counted: it grows with rays, and is most of what does.
    The rays are this `share` of a step's.
    """
    probed = rays[:: max(len(rays) // _PROBED_RAYS, 1)]
    kept = _kept_bytes(renderer, probed)
    state = sum(tensor.nbytes for tensor in renderer.state_dict().values())
    learned = sum(p.nbytes for p in renderer.parameters() if p.requires_grad)
    # Gradients and Adam's two moments beside the weights.
    num_rays = len(rays) / share
    needed: float = 3 * learned + kept * max(_STEP * num_rays, _EVALUATION * renderer.chunk_size)
    if device.type == "cuda":
        needed, there = needed + state, float(torch.cuda.mem_get_info(device)[0])
    else:
        resident = number_in(Path("/proc/self/status"), r"VmRSS:\s+(\d+)", 1024)
        needed, there = needed + resident + _LATER_BYTES, available_bytes() + resident
    if needed > there:
        raise NerfroError(
            f"the run needs about {needed / 1e9:.1f} GB of {device.type} memory and {max(there, 0) / 1e9:.1f} GB are "
            f"free; {kept / 1e3:.0f} kB are for each ray: take a smaller batches.size or evaluation.chunk_size"
        )
    of = "" if there == math.inf else f" of {there / 1e9:.1f} GB that are free"
    return f"memory: about {needed / 1e9:.1f} GB{of}, {kept / 1e3:.0f} kB of it for each of {num_rays:.0f} rays a step"


def _kept_bytes(renderer: Renderer, rays: Rays) -> float:
    """Bytes that autograd keeps of each ray for the backward pass, parameters left out."""
    of_model = {tensor.untyped_storage().data_ptr() for tensor in renderer.state_dict().values()}
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in of_model:
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    draws = Draws(0, 0, torch.arange(len(rays), device=rays.near.device))
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        renderings = renderer(rays, draws)  # what is kept lives as long as this does, so that no address occurs twice
        del renderings
    return sum(kept.values()) / len(rays)
