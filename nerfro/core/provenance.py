"""Command line, versions of packages and settings of algorithms, for records of results."""

from __future__ import annotations

import shlex
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import ClassVar

_PACKAGES = ("nerfro", "torch", "lightning", "hydra-core", "torchmetrics", "numpy", "numba", "trimesh")


class AlgorithmSettings:
    """Base class of the settings of an algorithm: a frozen dataclass of tuned numbers with a default for each.

    The function of the algorithm takes an instance as its argument `settings` and calls `use`. `nerfro plugins
    settings` lists all subclasses; run.json and scene.json record the settings that their run has used.

    Attributes:
        classes: all subclasses by name.
        used: the settings of algorithms that have run since the start of the last preprocessing or training in this
            process, by class, as Python expressions.
    """

    classes: ClassVar[dict[str, type[AlgorithmSettings]]] = {}
    used: ClassVar[dict[str, str]] = {}

    def __init_subclass__(cls) -> None:
        AlgorithmSettings.classes[cls.__name__] = cls

    def use(self) -> None:
        """Remember these settings for the records of the run."""
        AlgorithmSettings.used[type(self).__name__] = repr(self)


def command_of_process() -> str:
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
