"""Command line and versions of packages, for records of results."""

from __future__ import annotations

import shlex
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ("nerfro", "torch", "lightning", "hydra-core", "torchmetrics", "numpy", "numba", "trimesh")


def command_line() -> str:
    """Return the command line of this process."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    program = [sys.argv[0]] if spec is None else ["-m", spec.name]
    return shlex.join([Path(sys.executable).name, *program, *sys.argv[1:]])


def versions() -> dict[str, str | None]:
    """Return the versions of the packages that results depend on; None for a package that is not installed."""
    return {name: _version(name) for name in _PACKAGES}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
