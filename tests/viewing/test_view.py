"""`python -m nerfro.view` serves the page of a trained run."""

import signal
import time
import urllib.request
from pathlib import Path

from tests.forked import Command


def test_run_is_served_until_ctrl_c(trained_run: Path, tmp_path: Path) -> None:
    options = [f"checkpoint={trained_run}", "port=0", "open=false", "resolution=8", "device=cpu"]
    served = Command("view", options, tmp_path / "log")
    try:
        address = served.until(r"on (http://localhost:\d+); Ctrl-C ends it")[1]
        text = ""
        deadline = time.monotonic() + 120
        while "<canvas" not in text and time.monotonic() < deadline:  # the page is made after the address is printed
            time.sleep(0.2)
            with urllib.request.urlopen(address) as answer:
                text = answer.read().decode()
        assert "<canvas" in text
    finally:
        served.send(signal.SIGINT)
    assert served.wait() == 130, served.errors
