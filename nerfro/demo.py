"""`python -m nerfro.demo`: learn the embedded scene in 90 seconds, on a page that shows it as it learns.

Examples:
    nerfro demo
    nerfro demo trainer.max_time=5m seed=1
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
from datetime import datetime
from pathlib import Path
from typing import TextIO

import nerfro.cli.startup
from nerfro.cli.failures import errors_in_one_line
from nerfro.core.trust import leave_current_directory
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
        leave_current_directory()
        folder = Path("outputs", f"demo_{datetime.now():%Y-%m-%d_%H-%M-%S}").resolve()
        with contextlib.redirect_stdout(_Addresses(sys.stdout)):
            # The package imports the functions on access, after the line above.
            run = nerfro.train(overrides=[*_OPTIONS, *sys.argv[1:]], out=folder)
            page = nerfro.export(run, "page", folder / "page.html")
        assert run.scores is not None  # of the test views
        psnr, num_views = run.scores.result.mean("psnr"), len(run.scores.result.views)
        print(f"PSNR {psnr:.1f} dB on {num_views} photographs that were not trained on; page: {page}")


class _Addresses(io.StringIO):
    """Output of which only the address of the page is shown; errors and progress are on standard error."""

    def __init__(self, shown: TextIO) -> None:
        super().__init__()
        self._shown = shown

    def write(self, text: str) -> int:
        address = re.search(r"http://\S+", text)
        if address is not None:
            with contextlib.redirect_stdout(self._shown):
                print(text.rstrip(), flush=True)
                open_page(address[0])
        return len(text)


if __name__ == "__main__":
    main()
