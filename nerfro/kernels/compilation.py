"""How kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable)

# OpenMP threads spin while they wait. Numba's and PyTorch's are two pools, so that each would keep the other from the
# cores: a training step took five times as long. Numba's own work queue sleeps. NUMBA_THREADING_LAYER overrides this.
if numba.config.THREADING_LAYER == "default":  # type: ignore[attr-defined]
    numba.config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]


def compiled(function: Function) -> Function:
    """Compile for one thread on the first call, and keep the machine code on disk."""
    return _compile(function, parallel=False)


def compiled_parallel(function: Function) -> Function:
    """Compile with `prange` loops spread over the cores, and keep the machine code on disk."""
    return _compile(function, parallel=True)


def _compile(function: Function, parallel: bool) -> Function:
    # Fused multiply-add is the only liberty taken with floating point: infinities and exact comparisons stay.
    options: dict[str, Any] = {"parallel": parallel, "fastmath": {"contract"}, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:
        # Numba keeps compiled code beside the source, else in NUMBA_CACHE_DIR or the user's cache folder. Where none of
        # them can be written (a read-only install without a home) it refuses; then every process compiles anew.
        return numba.njit(**options)(function)
