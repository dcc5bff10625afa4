"""`python -m nerfro.view` serves a trained run, with the losses that it has logged."""

from __future__ import annotations

import json
import shutil
import signal
import time
import urllib.request
from pathlib import Path

from tests.forked import Command


def test_a_run_is_served_with_its_curve(trained_run: Path, tmp_path: Path) -> None:
    shutil.copytree(trained_run, tmp_path / "run")
    options = [f"checkpoint={tmp_path / 'run'}", "port=0", "open=false", "resolution=8", "device=cpu"]
    served = Command("view", options, tmp_path / "log")
    try:
        address = served.until(r"on (http://localhost:\d+); Ctrl-C ends it")[1]
        assert "<canvas" in text(address)
        logged = losses(address)
        assert [step for step, _ in logged] == [0, 1]
        assert all(loss > 0 for _, loss in logged)
        # A training elsewhere goes on.
        file = tmp_path / "run" / "csv" / "metrics.csv"
        header, *rows = file.read_text().splitlines()
        row = dict(zip(header.split(","), rows[-1].split(","), strict=True)) | {"step": "2", "loss/total": "0.125"}
        file.write_text("\n".join([header, *rows, ",".join(row.values()), "7,0.0"]))  # the last row is incomplete
        deadline = time.monotonic() + 30
        while losses(address)[-1] != [2, 0.125]:
            assert time.monotonic() < deadline
            time.sleep(0.5)
    finally:
        served.send(signal.SIGINT)
    assert served.wait() == 130, served.errors


def text(address: str) -> str:
    with urllib.request.urlopen(address) as answer:
        return answer.read().decode()


def losses(url: str) -> list[list[float]]:
    return json.loads(text(f"{url}/state"))["losses"]
