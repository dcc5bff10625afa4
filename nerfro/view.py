"""`python -m nerfro.view checkpoint=RUN`: serve a run's interactive page.

Examples:
    nerfro view checkpoint=outputs/first
    nerfro view checkpoint=outputs/first port=0 open=false
"""

# ruff: noqa: UP045 - OmegaConf on Python 3.10 wants Optional

from __future__ import annotations

import signal
from dataclasses import dataclass
from typing import Annotated, Optional

from annotated_types import Ge, Le
from omegaconf import MISSING, DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.training.load import load
from nerfro.viewing.page import make_page
from nerfro.viewing.server import PageServer, open_page
from nerfro.viewing.volume import RESOLUTION


@dataclass
class ViewConfig:
    """Options of `python -m nerfro.view`."""

    checkpoint: str = MISSING  # run folder, or a checkpoint in it
    host: str = "localhost"  # address of the server; 0.0.0.0 accepts connections from other machines
    port: Annotated[int, Ge(0), Le(65535)] = 8008  # 0 for any free port
    open: bool = True  # whether to open a browser
    resolution: Annotated[int, Ge(2)] = RESOLUTION  # grid vertices along the longest side of the volume
    root: Optional[str] = None  # folder of the data, if it has moved since training
    device: str = "auto"  # `cpu` or `cuda`; `auto` means the CPU


@entry_point("view", ViewConfig)
def main(config: DictConfig) -> None:
    """Serve the page until Ctrl-C."""
    scene = load(config.checkpoint, config.device, config.root)
    server = PageServer(config.host, config.port)
    server.open(make_page(scene, config.resolution))
    print(f"nerfro: {scene.name} on {server.url}; Ctrl-C ends it", flush=True)
    if config.open:
        open_page(server.url)
    signal.pause()


if __name__ == "__main__":
    main()
