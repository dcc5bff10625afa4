"""`python -m nerfro.view checkpoint=RUN`: serve a run's interactive page.

Examples:
    nerfro view checkpoint=outputs/first
    nerfro view checkpoint=outputs/first port=0 open=false
"""

from __future__ import annotations

import signal
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le
from omegaconf import MISSING

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.training.run_folder import load
from nerfro.viewing.page import make_page
from nerfro.viewing.server import PageServer, open_page
from nerfro.viewing.volume import RESOLUTION


@dataclass
class ViewConfig:
    """Options of `python -m nerfro.view`.

    Attributes:
        checkpoint: run folder, or a checkpoint in it.
        host: address of the server; 0.0.0.0 accepts connections from other machines.
        port: 0 for any free port.
        open: whether to open a browser.
        resolution: grid vertices along the longest side of the volume.
        root: folder of the data, if it has moved since training.
        device: `cpu` or `cuda`; `auto` means the CPU.
    """

    checkpoint: str = MISSING
    host: str = "localhost"
    port: Annotated[int, Ge(0), Le(65535)] = 8008
    open: bool = True
    resolution: Annotated[int, Ge(2)] = RESOLUTION
    root: str | None = None
    device: str = "auto"


@entry_point("view", ViewConfig)
def main(options: ViewConfig) -> None:
    """Serve the page until Ctrl-C."""
    server = PageServer(options.host, options.port)
    scene = load(options.checkpoint, options.device, options.root)
    print(f"nerfro: {options.checkpoint} on {server.url}; Ctrl-C ends it", flush=True)
    if options.open:
        open_page(server.url)  # the browser starts while the page is made
    server.open(make_page(scene, options.resolution))
    signal.pause()


if __name__ == "__main__":
    main()
