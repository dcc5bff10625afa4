"""`python -m nerfro.demo`: learn the embedded scene in 90 seconds, on a page that shows it as it learns.

Examples:
    nerfro demo
    nerfro demo trainer.max_time=5m seed=1
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.failures import errors_in_one_line
from nerfro.core.trust import command_of_module
from nerfro.evaluation.results import read_metrics_json
from nerfro.viewing.server import open_page

_OPTIONS = (
    "trainer.max_time=90s",
    "trainer.limit_test_batches=5",
    "evaluation.every=0",
    "viewer=true",
    "viewer_port=0",
)


def main() -> None:
    """Train with the interactive page, export the final page, and print where it is."""
    with errors_in_one_line():
        print("nerfro: starting; the first start compiles kernels, up to a minute", file=sys.stderr, flush=True)
        folder = Path("outputs", f"demo_{datetime.now():%Y-%m-%d_%H-%M-%S}").resolve()
        _run("train", *_OPTIONS, f"hydra.run.dir={folder}", *sys.argv[1:])
        _run("export", f"checkpoint={folder}", "what=page", f"out={folder / 'page.html'}")
        result = read_metrics_json(folder / "metrics.json").result
        psnr, num_views = result.mean("psnr"), len(result.views)
        print(f"PSNR {psnr:.1f} dB on {num_views} photographs that were not trained on; page: {folder / 'page.html'}")


def _run(command: str, *options: str) -> None:
    """Run a command, and show only the address of its page; errors and progress are on standard error."""
    arguments = [*command_of_module(f"nerfro.{command}"), *options]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        before = signal.signal(signal.SIGINT, lambda number, frame: None)  # the command ends in a line of its own
        for line in process.stdout or ():
            address = re.search(r"http://\S+", line)
            if address is not None:
                print(line, end="", flush=True)
                open_page(address[0])
    signal.signal(signal.SIGINT, before)
    if process.returncode != 0:
        sys.exit(process.returncode)


if __name__ == "__main__":
    main()
