"""Python in separate processes."""

import os
import subprocess
import sys
from pathlib import Path

ONE_THREAD = {"OMP_NUM_THREADS": "1"}


def python(*arguments: str, folder: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python with arguments in a folder, with variables beside those of the tests."""
    variables = os.environ | environment
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=variables, capture_output=True, text=True, timeout=600
    )


def printed_by(*arguments: str, folder: Path | None = None, **environment: str) -> str:
    """Run Python like `python`; it must succeed. Returns what it printed."""
    done = python(*arguments, folder=folder, **environment)
    assert done.returncode == 0, done.stderr
    return done.stdout
