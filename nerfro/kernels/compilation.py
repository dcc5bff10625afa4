"""Compilation of kernels, the cache of machine code, and the threads that kernels run on."""

from __future__ import annotations

import ast
import contextlib
import errno
import functools
import hashlib
import importlib.util
import inspect
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import torch
from numba.core.caching import FunctionCache, IndexDataCacheFile

from nerfro.core.errors import warn
from nerfro.core.paths import cache_dir

_KERNEL_BYTES = 2**24  # free disk space for the machine code of a kernel
Function = TypeVar("Function", bound=Callable)
# Numba's work queue aborts the process if two threads launch parallel loops at the same time.
_ONE_CALLER = threading.Lock()
# Threads that help with `share` while they are idle.
HELPERS: list[Executor] = []
Result = TypeVar("Result")


def compiled(function: Function) -> Function:
    """Compile a function for one thread at the first call, cache the machine code on disk, and release Python's lock.

    The function must not create arrays. Numba then omits reference counts of arrays; reference counts took 30 % of the
    time of tracing. Calling kernels contain the code of the function, because calls pass many numbers in memory.
    """
    return _compile(function, parallel=False, allocates=False)


def inlined(function: Function) -> Function:
    """Compile a function into all calling kernels, for code that runs at every step along a ray."""
    return cast(Function, numba.njit(inline="always")(inspect.unwrap(function)))


def compiled_parallel(function: Function) -> Function:
    """Compile a function with `prange` loops over the cores of PyTorch, and cache the machine code on disk.

    If PyTorch uses one core in the calling thread, the loops run in the calling thread, and several threads can run
    kernels at the same time. Parallel kernels wait for each other.
    """
    serial, parallel = _compile(function, parallel=False), _compile(function, parallel=True)

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        if 1 in (torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS):  # type: ignore[attr-defined]
            return serial(*arguments)
        with parallel_threads():
            return parallel(*arguments)

    return cast(Function, run)


def _compile(function: Function, parallel: bool, allocates: bool = True) -> Function:
    function = inspect.unwrap(function)  # Numba cannot compile the type checks that tests add
    # Fused multiply-add is the only relaxation of floating-point arithmetic: infinities and exact comparisons stay.
    options: dict[str, Any] = {"parallel": parallel, "nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}
    if not allocates:
        options["_nrt"] = False  # Numba's run time, which allocates and counts references
        options["forceinline"] = True
    configured = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    # The installed package may be read-only, and Numba does not tell the two forms of a function apart.
    base = Path(configured) if configured else cache_dir() / "kernels"
    folder = base / _fingerprint(function.__module__) / ("parallel" if parallel else "serial")
    try:
        # Numba would try __pycache__ next, where machine code of other versions of imported files may lie.
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        if shutil.disk_usage(folder).free < _KERNEL_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]  # read while the function's cache is made
        dispatcher = numba.njit(**options)(function)
        dispatcher._cache = _MachineCode(function)
        return dispatcher
    except (RuntimeError, OSError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        _warn_of_compiling(base, "NUMBA_CACHE_DIR" if configured else "NERFRO_CACHE", reason)
        return numba.njit(**options)(function)
    finally:
        numba.config.CACHE_DIR = configured  # type: ignore[attr-defined]


class _Index(IndexDataCacheFile):
    """Index of the machine code of a function, which is empty if a class of its arguments has moved.

    The index names classes with their modules, and a kernel need not import the classes of its arguments.
    """

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except (ImportError, AttributeError):
            return {}


class _MachineCode(FunctionCache):
    """Machine code of a function on disk."""

    def __init__(self, function: Callable) -> None:
        super().__init__(function)
        self._cache_file = _Index(self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp())


@functools.cache
def _warn_of_compiling(folder: Path, variable: str, reason: str) -> None:
    warn(
        f"machine code cannot be kept in {folder} ({reason}), so every process compiles its kernels, which takes up to "
        f"a minute; set {variable} to a folder that can be written"
    )


@functools.cache
def _fingerprint(module: str) -> str:
    """Hash all sources behind the kernels of a module.

    Numba compiles a function again after a change of the file with the function, but not after a change of files with
    constants or called functions. Without the hash, Numba would run outdated machine code.
    """
    digest = hashlib.sha256()
    for _, source in sorted(imported_sources(module).items()):
        digest.update(source)
    return digest.hexdigest()[:16]


def imported_sources(module: str) -> dict[str, bytes]:
    """Read the sources of a module and of all imported modules of nerfro and of the same package.

    Args:
        module: dotted name of an imported module; the import may be in progress.

    Returns:
        Sources by dotted name of the module, without imports within functions and for type checkers, because such
        imports cannot reach compiled code.
    """
    packages = {"nerfro", module.partition(".")[0]}
    sources: dict[str, bytes] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        file = getattr(sys.modules.get(name), "__file__", None)
        if name in sources or file is None or name.partition(".")[0] not in packages:
            continue
        sources[name] = Path(file).read_bytes()
        if name != __name__:  # This module decides how kernels are compiled; its imports do not.
            waiting += _imports(sources[name], getattr(sys.modules[name], "__package__", None))
    return sources


@functools.cache
def _imports(source: bytes, package: str | None) -> list[str]:
    """Return the names of imported modules, and of names in modules, which may be modules as well."""
    names = []
    for node in ast.parse(source).body:
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            names += [module, *(f"{module}.{alias.name}" for alias in node.names)]
    return names


def share(task: Callable[[int], Result], number: int) -> list[Result]:
    """Call a function for all numbers from 0, without gradients, in this thread and in helping threads that are idle.

    The thread of a call depends on the speed of the threads, so the results must not depend on the thread.

    Args:
        task: function of a number.
        number: number of calls.

    Returns:
        Results in the order of the numbers.
    """
    if number == 1:
        with torch.no_grad():
            return [task(0)]
    results: dict[int, Result] = {}
    numbers = iter(range(number))

    inference = torch.is_inference_mode_enabled()  # a mode of the thread

    def work() -> None:
        with torch.inference_mode(inference), torch.no_grad():
            for i in numbers:
                results[i] = task(i)

    begun = [thread.submit(work) for thread in HELPERS[: number - 1]]
    try:
        work()
    finally:
        for help in begun:
            # The work of a busy thread has not begun and is cancelled, because nothing is left to do.
            if not help.cancel():
                help.result()
    return [results[i] for i in range(number)]


def num_threads() -> int:
    """Return the number of threads for kernels that the calling thread launches: as many as PyTorch uses."""
    available: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # Numba sets it while importing
    return min(torch.get_num_threads(), available)


@contextlib.contextmanager
def parallel_threads() -> Iterator[None]:
    """Reserve Numba's threads for one parallel kernel; other threads of Python wait until it has finished."""
    with _ONE_CALLER:
        _start_threads()
        numba.set_num_threads(num_threads())
        yield


@functools.cache
def _start_threads() -> None:
    """Start Numba's threads as a work queue, unless the process has chosen another threading layer.

    OpenMP threads spin while they wait. Numba and PyTorch have a pool of threads each, and the two pools would keep
    each other from the cores: a training step took five times as long. Threads of the work queue sleep while they wait.
    """
    with contextlib.suppress(ValueError):
        numba.threading_layer()
        return  # The threads run already.
    configured = numba.config.THREADING_LAYER  # type: ignore[attr-defined]
    try:
        if configured == "default":
            numba.config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]
        numba.get_num_threads()  # Numba reads its configuration and starts the threads at the first such call.
    finally:
        numba.config.THREADING_LAYER = configured  # type: ignore[attr-defined]
