"""The memory that there is, and what does not fit into it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path

from nerfro.errors import NerfroError


def require_bytes(num_bytes: float, what: str) -> None:
    """Refuse something that needs more memory than there is, before it is begun."""
    there = available_bytes()
    if num_bytes > there:
        raise NerfroError(
            f"{what} needs about {num_bytes / 1e9:.1f} GB of memory and {there / 1e9:.1f} GB are free; make it smaller"
        )


def available_bytes() -> float:
    """Memory that this process may still take: what the system has, within its control groups' limits.

    Infinite where nobody tells (other systems than Linux).
    """
    free = [number_in(Path("/proc/meminfo"), r"MemAvailable:\s+(\d+)", 1024, math.inf)]
    for folder, limit, usage in _control_groups():
        # Cached files count as used there, but are dropped when somebody needs the room.
        cache = number_in(folder / "memory.stat", r"^(?:total_)?inactive_file (\d+)")
        free.append(number_in(folder / limit, r"(\d+)", 1, math.inf) - number_in(folder / usage, r"(\d+)") + cache)
    return min(free)


def _control_groups() -> Iterator[tuple[Path, str, str]]:
    """Folders of this process's memory groups and those around them, with their files of limit and usage."""
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
    """The first number of a pattern in a file of the system; the default without either."""
    try:
        found = re.search(pattern, file.read_text(), re.MULTILINE)
    except OSError:
        return default
    return default if found is None else int(found[1]) * unit
