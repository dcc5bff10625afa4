"""Cost of a browser that watches a training (`viewer=true`). Prints Markdown.

    python benchmarks/live_page.py

One run trains on the embedded scene. Windows with and without a headless Chromium that shows the live page alternate;
the start of each browser, and ten seconds after its start and its end, do not count. All times are processor time, so
that they do not depend on other programs: that of the training process, and that of the threads in it that make updates
and answer requests. The browser renders in software (SwiftShader) on the same machine; its own processor time is
compared with the time that passes.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import nerfro.training.run
from benchmarks.page import processor_seconds
from nerfro.train import main as train
from nerfro.training.viewer import Viewer
from nerfro.viewing import server
from tests.viewing.browser import Browser

SPENT: Counter[str] = Counter()  # seconds
START = 10.0  # seconds after the start and the end of a browser that do not count


class MeasuredViewer(Viewer):
    """Measures each step and its update, separately with (`True`) and without (`False`) a browser that watches.

    `counted` is None while a browser starts.
    """

    counted: bool | None = False

    def on_train_start(self, *arguments: Any) -> None:
        super().on_train_start(*arguments)
        self.process = time.process_time()

    def on_train_batch_end(self, *arguments: Any, **named: Any) -> None:
        assert self._server is not None
        watched, thread = MeasuredViewer.counted, time.thread_time()
        super().on_train_batch_end(*arguments, **named)
        SPENT[f"updates {watched}"] += time.thread_time() - thread
        before, self.process = self.process, time.process_time()
        SPENT[f"process {watched}"] += self.process - before
        MeasuredViewer.url = self._server.url


class MeasuredHandler(server._Handler):
    """Measures the answers to requests."""

    def do_GET(self) -> None:  # noqa: N802 (name of the base class)
        thread = time.thread_time()
        super().do_GET()
        SPENT["answers"] += time.thread_time() - thread


def watch(window: float, done: threading.Event) -> None:
    """Show the page in a browser during every second window of time, seconds."""
    while not done.wait(window):
        if hasattr(MeasuredViewer, "url"):
            MeasuredViewer.counted = None
            with tempfile.TemporaryDirectory() as folder, Browser(MeasuredViewer.url, Path(folder)) as browser:
                done.wait(START)
                MeasuredViewer.counted, answers = True, SPENT["answers"]
                start, begun = processor_seconds(browser.pid), time.monotonic()
                done.wait(window)
                MeasuredViewer.counted = None
                SPENT["browser"] += processor_seconds(browser.pid) - start
                SPENT["window"] += time.monotonic() - begun
                SPENT["counted answers"] += SPENT["answers"] - answers
            done.wait(START)  # the server regards the page as shown for a while
            MeasuredViewer.counted = False


def main() -> None:
    """Train, and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=240, help="of training")
    parser.add_argument("--window", type=float, default=30.0, help="seconds")
    parser.add_argument("--options", nargs="+", default=[], help="of nerfro.train")
    arguments = parser.parse_args()
    if shutil.which("chromium") is None:
        parser.error("Chromium is not installed; install it, for example with apt install chromium")
    nerfro.training.run.Viewer, server._Handler = MeasuredViewer, MeasuredHandler  # type: ignore[misc]
    done = threading.Event()
    thread = threading.Thread(target=watch, args=(arguments.window, done))
    thread.start()
    with tempfile.TemporaryDirectory() as folder:
        limit = f"trainer.max_time=00:00:{arguments.seconds // 60:02d}:{arguments.seconds % 60:02d}"
        options = ["viewer=true", "viewer_port=0", limit, "evaluation.every=0", "evaluation.split=null", "logger=none"]
        sys.argv = ["nerfro.train", *arguments.options, *options, f"hydra.run.dir={folder}/run"]
        try:
            train()
        finally:
            done.set()
            thread.join()
    print("| | without a browser | with a browser |\n|---|---|---|")
    shares = [SPENT[f"updates {watched}"] / max(SPENT[f"process {watched}"], 1e-9) for watched in (False, True)]
    print(f"| share of updates and curves in the processor time | {shares[0]:.2%} | {shares[1]:.2%} |")
    answers = SPENT["counted answers"] / max(SPENT["process True"], 1e-9)
    print(f"| share of answers to the browser in the processor time | 0 | {answers:.2%} |")
    print(f"| processor time of the browser per second | | {SPENT['browser'] / max(SPENT['window'], 1e-9):.3f} |")


if __name__ == "__main__":
    main()
