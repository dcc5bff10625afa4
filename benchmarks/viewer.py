"""Measure how much `viewer=true` slows down training: `python benchmarks/viewer.py`.

One run trains on the embedded scene. Windows with and without requests of a browser alternate, so that both kinds of
windows see the same phases of the training and the same load of the machine.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
import urllib.request
from itertools import pairwise
from typing import Any

import nerfro.train
from nerfro.training.viewer import Viewer
from nerfro.viewing import server


class TimedViewer(Viewer):
    """Record the end of each step, and whether a browser was connected."""

    steps: list[tuple[float, bool]] = []  # noqa: RUF012 (of the one run)
    baking: list[float] = []  # noqa: RUF012
    page: server.PageServer

    def on_train_batch_end(self, *arguments: Any, **named: Any) -> None:
        assert self._server is not None
        TimedViewer.page = self._server
        begun = time.perf_counter()
        super().on_train_batch_end(*arguments, **named)
        now = time.perf_counter()
        self.baking.append(now - begun)
        self.steps.append((now, self._server.watched))


def browse(window: float) -> None:
    """Poll the server every two seconds in every second window, as the page does."""
    begun = time.monotonic()
    while True:
        time.sleep(2)
        if (time.monotonic() - begun) // window % 2 == 0 and hasattr(TimedViewer, "page"):
            urllib.request.urlopen(f"{TimedViewer.page.url}/state?after=0").read()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=int, default=240, help="of training")
    parser.add_argument("--warm-up", type=float, default=20.0, help="seconds that are not counted")
    parser.add_argument("--window", type=float, default=20.0, help="seconds")
    parser.add_argument("--options", nargs="+", default=[], help="of nerfro.train")
    arguments = parser.parse_args()
    server._WATCHED_SECONDS = 2.5  # a window without requests begins soon after the last one
    nerfro.train.Viewer = TimedViewer  # type: ignore[misc]
    threading.Thread(target=browse, args=(arguments.window,), daemon=True).start()
    with tempfile.TemporaryDirectory() as folder:
        limit = f"trainer.max_time=00:00:{arguments.seconds // 60:02d}:{arguments.seconds % 60:02d}"
        options = ["viewer=true", "viewer_port=0", limit, "evaluation.every=0", "logger=none"]
        sys.argv = ["nerfro.train", *arguments.options, *options, f"hydra.run.dir={folder}/run"]
        nerfro.train.main()
    steps = [(at, watched) for at, watched in TimedViewer.steps if at > TimedViewer.steps[0][0] + arguments.warm_up]
    spent = {True: 0.0, False: 0.0}
    count = {True: 0, False: 0}
    for (before, _), (now, watched) in pairwise(steps):
        spent[watched] += now - before
        count[watched] += 1
    rate = {watched: count[watched] / spent[watched] for watched in spent}
    print(f"{rate[False]:.3f} steps/s without, {rate[True]:.3f} with a browser: {rate[False] / rate[True] - 1:.1%}")
    shown = TimedViewer.page._version
    print(f"a new state every {spent[True] / max(shown, 1):.0f} s of those with a browser")
    baking = sum(TimedViewer.baking) / (steps[-1][0] - TimedViewer.steps[0][0])
    print(f"baking and publishing: {baking:.1%} of the time; {spent[True]:.0f} s with, {spent[False]:.0f} s without")


if __name__ == "__main__":
    main()
