"""Import of the packages that the extras of nerfro install."""

from __future__ import annotations

import importlib
from typing import Any

from nerfro.core.errors import NerfroError


def optional(module: str, extra: str, purpose: str, alternative: str = "") -> Any:
    """Import a module of an optional package where it is used.

    Args:
        module: full name of the module, such as `pyarrow.parquet`.
        extra: extra of nerfro that installs the package.
        purpose: beginning of the error message, such as "target=colmap needs pycolmap".
        alternative: end of the error message: what to do instead of the installation.

    Raises:
        NerfroError: the package cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise NerfroError(f"{purpose} ({error}); pip install 'nerfro[{extra}]'{alternative}") from error
