"""`python -m nerfro.demo`: learn the embedded scene in 90 seconds, on a page that shows it as it learns.

In a terminal, the command then serves the final page until Ctrl-C; in a script, it ends. `serve=true` and `serve=false`
select one of these. Other options are those of `nerfro train`.

Examples:
    nerfro demo
    nerfro demo trainer.max_time=5m seed=1 serve=false
"""

from __future__ import annotations

import contextlib
import io
import re
import signal
import sys
from datetime import datetime
from pathlib import Path
from urllib.parse import urlsplit

import nerfro.cli.startup
from nerfro.cli.failures import errors_in_one_line
from nerfro.cli.overrides import as_overrides, command_line
from nerfro.core.errors import NerfroError
from nerfro.core.paths import shown
from nerfro.core.trust import leave_current_directory
from nerfro.viewing.server import PageServer, open_page

_OPTIONS = (
    "trainer.max_time=90s",
    "trainer.limit_test_batches=5",
    "evaluation.every=0",
    "viewer=true",
    "viewer_port=0",
)


def main() -> None:
    """Train with the interactive page, export the final page, serve it, and print where it is."""
    with errors_in_one_line():
        print("nerfro: starting; the first start compiles kernels, up to a minute", file=sys.stderr, flush=True)
        leave_current_directory()
        options, serve = _options(sys.argv[1:])
        folder = Path("outputs", f"demo_{datetime.now():%Y-%m-%d_%H-%M-%S}").resolve()
        with contextlib.redirect_stdout(_Addresses()) as addresses:
            # The package imports the functions on access, after the line above.
            run = nerfro.train(overrides=[*_OPTIONS, *options], out=folder)
            page = nerfro.export(run, "page", folder / "page.html")
        assert run.scores is not None  # of the test views
        psnr, num_views = run.scores.result.mean("psnr"), len(run.scores.result.views)
        print(f"PSNR {psnr:.1f} dB on {num_views} photographs that were not trained on; page: {page}")
        film = {"checkpoint": shown(folder), "path": "orbit", "out": shown(folder / "orbit")}
        print(f"next, a film: {command_line('render', as_overrides(film))}", flush=True)
        if serve:
            _serve(page, addresses.url, f"The final page is ready: PSNR {psnr:.1f} dB.")


def _options(arguments: list[str]) -> tuple[list[str], bool]:
    """Separate the options of the training from `serve`; by default, a terminal is served and a script is not."""
    values = [argument.partition("=")[2] for argument in arguments if argument.startswith("serve=")]
    if not set(values) <= {"true", "false"}:
        raise NerfroError(f"serve={values[-1]} is not allowed; give serve=true or serve=false")
    serve = values[-1] == "true" if values else sys.stdin.isatty() and sys.stdout.isatty()
    return [argument for argument in arguments if not argument.startswith("serve=")], serve


def _serve(page: Path, url: str | None, outcome: str) -> None:
    """Serve the page until Ctrl-C, at the address of the live page, whose browsers then offer to open the final one."""
    try:
        server = PageServer("localhost", urlsplit(url).port or 0 if url else 0)
    except NerfroError:  # another program has taken the port
        server = PageServer("localhost", 0)
    server.open(page.read_text(encoding="utf-8"), is_final=True)
    server.complete(outcome)
    print(f"nerfro: the final page is on {server.url}; Ctrl-C ends it", flush=True)
    signal.pause()


class _Addresses(io.StringIO):
    """Output of which only the address of the page is shown; errors and progress are on standard error."""

    def __init__(self) -> None:
        super().__init__()
        self._shown = sys.stdout
        self.url: str | None = None

    def write(self, text: str) -> int:
        address = re.search(r"http://\S+", text)
        if address is not None:
            with contextlib.redirect_stdout(self._shown):
                print(text.rstrip(), flush=True)
                self.url = address[0]
                open_page(address[0])
        return len(text)


if __name__ == "__main__":
    main()
