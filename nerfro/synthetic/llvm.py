"""Choice of the LLVM library that Dr.Jit, the compiler behind Mitsuba, loads at run time.

Dr.Jit loads the library in the environment variable `DRJIT_LIBLLVM_PATH`, otherwise `libLLVM.so`, otherwise one of the
versions in the system's library folder. Dr.Jit accepts LLVM 15, which aborts the process while compiling vector code on
processors with AVX-512. Therefore nerfro sets the variable to the newest library before Dr.Jit is loaded, and later
queries the version of the loaded library.
"""

from __future__ import annotations

import os
import re
import site
import sys
from collections.abc import Iterable
from pathlib import Path

from nerfro.core.errors import optional

PURPOSE = "rendering ground truth needs Mitsuba 3"
MIN_VERSION = 16
HINT = (
    f"install LLVM {MIN_VERSION} or newer (Debian: apt-get install libllvm19; Linux on x86-64: pip install "
    "'nerfro[synthesize]'; or set DRJIT_LIBLLVM_PATH to the library)"
)
_VARIABLE = "DRJIT_LIBLLVM_PATH"
_NAME = re.compile(r"libLLVM(?:-(\d+)[\d.]*)?\.(?:so|dylib)(?:\.(\d+)[\d.]*)?$")
_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/local/lib",
    "/opt/homebrew/opt/llvm/lib", "/usr/local/opt/llvm/lib",
)  # fmt: skip


def version_in_name(library: Path) -> int | None:
    """Return the major version in a file name: 15 for `libLLVM-15.so.1`, 19 for `libLLVM.so.19.1`, None for others."""
    match = _NAME.fullmatch(library.name)
    return int(version) if match and (version := match[1] or match[2]) else None


def newest(libraries: Iterable[Path]) -> Path | None:
    """Return the library with the highest version in its name, or None if all are older than `MIN_VERSION`."""
    usable = {version: library for library in libraries if (version := version_in_name(library)) is not None}
    version = max(usable, default=0)
    return usable[version] if version >= MIN_VERSION else None


def select_llvm() -> None:
    """Set `DRJIT_LIBLLVM_PATH` to the newest LLVM library of this machine, unless the variable is set already.

    Call this function before Dr.Jit is used for the first time, because Dr.Jit loads a library only once.
    """
    if _VARIABLE not in os.environ:
        # Wheels and conda install the library below the environment's prefix, or below the user's.
        folders = [Path(folder) for folder in (*_FOLDERS, Path(sys.prefix, "lib"), Path(site.getuserbase(), "lib"))]
        library = newest(path for folder in folders for path in folder.glob("libLLVM*") if path.is_file())
        if library is not None:
            os.environ[_VARIABLE] = str(library)


def missing_llvm() -> str | None:
    """Return the reason why Dr.Jit cannot compile for the processor, or None.

    The reason concerns the library that Dr.Jit has loaded. `select_llvm` chooses the library.
    """
    drjit = optional("drjit", "synthesize", PURPOSE)
    if not drjit.has_backend(drjit.JitBackend.LLVM):
        return "Dr.Jit finds no usable LLVM library"
    version = int(re.findall(r"\d+", str(drjit.detail.llvm_version()))[0])
    return None if version >= MIN_VERSION else f"Dr.Jit loads LLVM {version}, which is too old"
