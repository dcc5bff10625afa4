"""`python -m nerfro.view` serves a trained run, with the losses that it has logged."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path


def test_a_run_is_served_with_its_curve(train_here: Callable, tiny_run: list[str], tmp_path: Path) -> None:
    options = ["medium=sdf_grid" if option == "medium=voxel_grid" else option for option in tiny_run]
    options += ["logger=tensorboard", "trainer.log_every_n_steps=1", "trainer.max_steps=3"]
    done = train_here(*options, f"hydra.run.dir={tmp_path / 'run'}")
    assert done.code == 0, done.err
    command = [sys.executable, "-m", "nerfro.view", f"checkpoint={tmp_path / 'run'}", "port=0", "open=false",
               "resolution=8", "device=cpu"]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as served:
        try:
            assert served.stdout is not None
            found = re.search(r"on (http://localhost:\d+); Ctrl-C ends it", served.stdout.readline())
            assert found
            assert "<canvas" in text(found[1])
            logged = losses(found[1])
            assert [step for step, _ in logged] == [0, 1, 2]
            assert all(loss > 0 for _, loss in logged)
            # A training elsewhere goes on.
            file = tmp_path / "run" / "csv" / "metrics.csv"
            header, *rows = file.read_text().splitlines()
            row = dict(zip(header.split(","), rows[-1].split(","), strict=True)) | {"step": "3", "loss/total": "0.125"}
            file.write_text("\n".join([header, *rows, ",".join(row.values()), ""]))
            deadline = time.monotonic() + 30
            while losses(found[1])[-1] != [3, 0.125]:
                assert time.monotonic() < deadline
                time.sleep(0.5)
        finally:
            served.send_signal(signal.SIGINT)
    assert served.returncode == 130


def text(address: str) -> str:
    with urllib.request.urlopen(address) as answer:
        return answer.read().decode()


def losses(url: str) -> list[list[float]]:
    return json.loads(text(f"{url}/state"))["losses"]
