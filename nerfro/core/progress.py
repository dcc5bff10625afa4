"""Progress bars for long work, with one line per minute in log files, and durations as text."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

from tqdm import tqdm

from nerfro.core.errors import NerfroError

Item = TypeVar("Item")

DELAY = 2.0  # seconds after which a bar appears, so that short work has none
_LOG_SECONDS = 60.0  # interval between lines in a log file
_FORMAT = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"


class _LogFile:
    """Writes each state of a bar as one line of standard error, which is not a terminal."""

    _last = ""

    def write(self, text: str) -> None:
        line = text.strip()
        if line and line != self._last:  # tqdm writes the final state again when a bar is closed
            self._last = line
            sys.stderr.write(f"{line}\n")

    def flush(self) -> None:
        sys.stderr.flush()


def duration(seconds: float) -> str:
    """Format a duration, such as "1 h 30 min", "4 min" or "20 s"."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    parts = [f"{number} {unit}" for number, unit in ((hours, "h"), (minutes, "min"), (rest, "s")) if number]
    return " ".join(parts) or "0 s"


def progress_bar(description: str, total: float | None, items: Iterable[Any] | None = None, **options: Any) -> tqdm:
    """Create a progress bar with the remaining time on standard error; `update(n)` adds completed work.

    Args:
        description: name of the work.
        total: amount of work.
        items: items to iterate over.
        options: further arguments of tqdm.
    """
    form = _FORMAT
    if not sys.stderr.isatty():
        form = form.replace("|{bar}|", "")
        # With miniters=0, the monitor thread of tqdm does not add lines between two intervals.
        options |= {"file": _LogFile(), "mininterval": _LOG_SECONDS, "miniters": 0}
    return tqdm(items, description, total, bar_format=form, dynamic_ncols=True, **{"delay": DELAY, **options})


def track(description: str, items: Iterable[Item], total: int | None = None, **options: Any) -> Iterable[Item]:
    """Iterate over items and show a progress bar; `options` are further arguments of tqdm."""
    return progress_bar(description, total, items, **options)


@contextmanager
def counting_bar(description: str, total: float) -> Iterator[Callable[..., None]]:
    """Show a progress bar; the yielded function adds completed work, of 1 by default, up to the estimated total."""
    with progress_bar(description, total) as progress:
        yield lambda work=1: progress.update(min(work, total - progress.n))
        progress.update(total - progress.n)


@contextmanager
def fraction_bar(description: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar; the yielded function sets the completed fraction in [0, 1]."""
    with progress_bar(description, 1.0) as progress:
        yield lambda done: progress.update(done - progress.n)


def clock_time(duration: object) -> object:
    """Convert a duration with a unit, such as `90s`, `5m`, `1.5h` or `2d`, to the form DD:HH:MM:SS.

    Args:
        duration: `trainer.max_time`. None, and mappings, from which Lightning builds a `timedelta`, are returned as is.

    Raises:
        NerfroError: the text or number is not a duration.
    """
    if duration is None or isinstance(duration, Mapping) or re.fullmatch(r"\d+:\d\d:\d\d:\d\d", str(duration)):
        return duration
    match = re.fullmatch(r"(\d{1,6}(?:\.\d+)?)([smhd])", str(duration))
    if match is None:
        raise NerfroError(f"trainer.max_time={duration} is not a duration; write 90s, 5m, 1h, 2d or DD:HH:MM:SS")
    seconds = math.ceil(float(match[1]) * {"s": 1, "m": 60, "h": 3600, "d": 86400}[match[2]])
    return f"{seconds // 86400:02d}:{seconds // 3600 % 24:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
