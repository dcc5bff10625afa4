"""Memory of this process and its allocator, and fast number formats of the machine."""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Iterator
from pathlib import Path

import torch

from nerfro.core.errors import NerfroError

# Settings of glibc's mallopt (malloc.h). Blocks above M_MMAP_THRESHOLD (-3), 64 MiB, are returned to the system: steps
# of training and rendering allocate smaller blocks, and fits of the background larger ones. M_TRIM_THRESHOLD (-1):
# nothing else is returned.
_SETTINGS = {-3: 2**26, -1: 2**31 - 1}


def require_bytes(num_bytes: float, purpose: str) -> None:
    """Raise an error if an allocation exceeds the available memory."""
    free = available_bytes()
    if num_bytes > free:
        raise NerfroError(
            f"{purpose} needs about {num_bytes / 1e9:.1f} GB of memory, but {free / 1e9:.1f} GB are free; reduce it"
        )


def available_bytes() -> float:
    """Return the free memory of this process in bytes, within the limits of the system and of Linux control groups.

    The result is infinite on systems other than Linux, because they do not report the number.
    """
    free = [number_in(Path("/proc/meminfo"), r"MemAvailable:\s+(\d+)", 1024, math.inf)]
    for folder, limit, usage in _control_groups():
        # Control groups count cached files as used memory, although the kernel drops cached files on demand.
        cache = number_in(folder / "memory.stat", r"^(?:total_)?inactive_file (\d+)")
        free.append(number_in(folder / limit, r"(\d+)", 1, math.inf) - number_in(folder / usage, r"(\d+)") + cache)
    return min(free)


def _control_groups() -> Iterator[tuple[Path, str, str]]:
    """Yield the folders of the memory control groups of the process and of all parents, with limit and usage files."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":  # version 2
            root, files = Path("/sys/fs/cgroup"), ("memory.max", "memory.current")
        elif "memory" in controllers.split(","):
            root, files = Path("/sys/fs/cgroup/memory"), ("memory.limit_in_bytes", "memory.usage_in_bytes")
        else:
            continue
        inner = root / path.lstrip("/")
        for folder in (inner, *inner.parents):
            if folder.is_relative_to(root):
                yield folder, *files


def number_in(file: Path, pattern: str, unit: int = 1, default: float = 0) -> float:
    """Return the first match of a pattern in a system file as a number, or the default without a match."""
    try:
        match = re.search(pattern, file.read_text(), re.MULTILINE)
    except OSError:
        return default
    return default if match is None else int(match[1]) * unit


def find_gpu() -> torch.device | None:
    """Return the GPU that PyTorch can use: `cuda`, which includes ROCm, or `mps`; None without one."""
    if torch.cuda.is_available():
        return torch.device("cuda", 0)
    return torch.device("mps") if torch.backends.mps.is_available() else None


def require_accelerator(name: str) -> None:
    """Refuse the accelerator `gpu`, `cuda` or `mps` on a machine without such a device."""
    gpu = find_gpu()
    if name not in ("auto", "cpu") and (gpu is None or name not in ("gpu", gpu.type)):
        raise NerfroError(
            f"trainer.accelerator={name} needs a device that PyTorch {torch.__version__} does not find here; take auto "
            "or cpu, or install a driver and a version of PyTorch for the device"
        )


def require_backend(name: str, device: torch.device) -> None:
    """Refuse a backend of `torch.compile` that does not exist, or that fails on a device."""
    backends = torch.compiler.list_backends(exclude_tags=())
    if name not in backends:
        raise NerfroError(f"compile={name} is not a backend of torch.compile; set one of {', '.join(backends)}")
    try:
        torch.compile(torch.neg, backend=name)(torch.ones(2, device=device))
    except RuntimeError as error:
        reason = " ".join(str(error).split("\n")[:2])
        raise NerfroError(f"compile={name} fails on this machine ({reason}); leave it out") from error


def gpu_name(gpu: torch.device) -> str:
    """Return the name of a GPU, such as "NVIDIA H200"."""
    return torch.cuda.get_device_name(gpu) if gpu.type == "cuda" else "Apple GPU"


def fast_bfloat16(device: str) -> bool:
    """Return whether matrix products in bfloat16 are faster than in float32 on a device: `cpu`, `cuda`, ...

    Processors without bfloat16 units compute each number separately: with AVX2, a product of 16384x64 and 64x64
    takes 40 times as long as in float32. ARM's units are not used, because PyTorch does not report them.
    """
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device == "cpu" and torch.cpu._is_avx512_bf16_supported()


def keep_freed_memory() -> bool:
    """Let the process keep memory that is freed from now on, for the tensors of the next step.

    By default, glibc returns large blocks to the system when a tensor is freed. Every step then allocates the same
    memory again, one page fault and 4 KiB of zeros at a time, which can cost more than the arithmetic. The price is
    that the process keeps the memory until the process ends. Long-lived tensors must not be allocated among tensors of
    varying sizes, because freed gaps would not fit later tensors and the process would grow.

    Returns:
        Whether the C library supports the setting.
    """
    if not return_freed_memory():
        return False
    library = ctypes.CDLL(None)
    return all(library.mallopt(*setting) for setting in _SETTINGS.items())


def return_freed_memory() -> bool:
    """Return the memory that has been freed so far to the system, if the C library supports it."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, TypeError, AttributeError):  # not a Unix, or another C library
        return False
    return True
