"""How kernels are compiled, and where the machine code is kept."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from nerfro.files.cache import cache_dir
from nerfro.kernels.threads import use_threads
from nerfro.paths import PACKAGE_DIR

# Files that hold kernels, or the constants that are compiled into them; a kernel lies beside its plain twin.
_SOURCES = ("philox.py", "kernels/*.py", "geometry/*.py", "*/*_cpu.py")

Function = TypeVar("Function", bound=Callable)

# OpenMP threads spin while they wait. Numba's and PyTorch's are two pools, so that each would keep the other from the
# cores: a training step took five times as long. Numba's own work queue sleeps. NUMBA_THREADING_LAYER overrides this.
if numba.config.THREADING_LAYER == "default":  # type: ignore[attr-defined]
    numba.config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]


def compiled(function: Function) -> Function:
    """Compile for one thread on the first call, and keep the machine code on disk; Python goes on meanwhile.

    What is compiled so makes no arrays. Then it need not count who uses those that it is given, which took 30 %
    of the time of tracing.
    """
    return _compile(function, parallel=False, allocates=False)


def inlined(function: Function) -> Function:
    """Compile into the kernels that call it: for what is done at every step along a ray."""
    return cast(Function, numba.njit(inline="always")(function))


def compiled_parallel(function: Function) -> Function:
    """Compile with `prange` loops spread over the cores that PyTorch uses, and keep the machine code on disk.

    A thread to which PyTorch gives one core has the same loops run one after the other. Several threads may call
    those at once; Numba's work queue may have one caller only.
    """
    serial, parallel = _compile(function, parallel=False), _compile(function, parallel=True)

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        return (serial if use_threads() == 1 else parallel)(*arguments)

    return cast(Function, run)


def _compile(function: Function, parallel: bool, allocates: bool = True) -> Function:
    # Fused multiply-add is the only liberty taken with floating point: infinities and exact comparisons stay.
    options: dict[str, Any] = {"parallel": parallel, "nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}
    if not allocates:
        options["_nrt"] = False  # Numba's run time, which makes arrays and counts their users
    before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    # Numba looks at this once, when it makes the function's cache. An install may be read-only, hence a folder of ours;
    # and Numba takes the two forms of one function for the same.
    folder = (
        (Path(before) if before else cache_dir() / "kernels") / _fingerprint() / ("parallel" if parallel else "serial")
    )
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    try:
        return numba.njit(cache=True, **options)(function)
    except (RuntimeError, OSError):
        # Where no folder can be written, every process compiles anew.
        return numba.njit(**options)(function)
    finally:
        numba.config.CACHE_DIR = before  # type: ignore[attr-defined]


@functools.cache
def _fingerprint() -> str:
    """Hash of all sources that kernels are made of.

    Numba itself compiles again when a function's own file has changed, but not when the file of a function that it
    calls has: it would go on running old machine code.
    """
    digest = hashlib.sha256()
    for pattern in _SOURCES:
        for file in sorted(PACKAGE_DIR.glob(pattern)):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
