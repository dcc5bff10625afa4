"""`python -m nerfro.dashboard`: names of runs, and a real server that shows them."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
from torch.utils.tensorboard import SummaryWriter

from nerfro.report.dashboard import link_runs, run_name


def make_run(folder: Path, name: str, root: str) -> None:
    """A run folder with one logged value."""
    with SummaryWriter(str(folder / "tensorboard")) as writer:
        writer.add_scalar("loss/total", 1.0, 3)
    (folder / "config.yaml").write_text(f"name: {name}\ndata: {{root: {root}}}\n")


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    make_run(tmp_path / "outputs" / "refractive" / "2026-01-02_03-04-05", "refractive", "embedded:torus")
    make_run(tmp_path / "outputs" / "sweeps" / "seeds" / "mipnerf-ship-seed1", "mipnerf", "outputs/scenes/ship")
    return tmp_path / "outputs"


NAMES = ["mipnerf/ship/seeds/seed1", "refractive/torus/2026-01-02_03-04-05"]


def test_runs_are_named_by_experiment_and_scene(outputs: Path, tmp_path: Path) -> None:
    names = tmp_path / "names"
    assert link_runs(outputs, names) == 2
    assert sorted(path.relative_to(names).as_posix() for path in names.rglob("*") if path.is_symlink()) == NAMES
    make_run(outputs / "late", "nerf", "/data/star")
    assert link_runs(outputs, names) == 3, "what is there stays, and new runs are added"
    assert list((names / "nerf" / "star" / "late").glob("events.*"))


@pytest.mark.parametrize("name", ["../../../evil", "/tmp/evil", "..", "a/b"])
def test_a_runs_name_leads_nowhere_else(name: str, tmp_path: Path) -> None:
    make_run(tmp_path / "outputs" / "run", name, "embedded:torus")
    parts = run_name(tmp_path / "outputs" / "run", tmp_path / "outputs").split("/")
    assert len(parts) == 3
    assert not {"", ".", ".."} & set(parts)


@pytest.mark.parametrize("content", ["name: [", "name: ${oc.env:HOME}\ndata: {root: a}", "- 1", "\xff"])
def test_a_damaged_configuration_does_not_end_the_dashboard(content: str, outputs: Path) -> None:
    folder = outputs / "sweeps" / "seeds" / "mipnerf-ship-seed1"
    (folder / "config.yaml").write_bytes(content.encode("latin-1"))
    assert run_name(folder, outputs) == "sweeps/seeds/mipnerf-ship-seed1"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["outputs=nowhere"], "outputs=nowhere is not a folder"),
        (["outputs=.", "port=-5"], "port=-5 is not allowed"),
        (["outputs=.", "host=nosuchhost.invalid"], "host=nosuchhost.invalid is not an address"),
    ],
)
def test_refuses_in_one_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_here: Callable
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run_here("dashboard", "open=false", *arguments)
    assert done.code == 1
    assert message in done.err


@pytest.mark.slow
def test_server_shows_the_runs_and_leaves_nothing_behind(outputs: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "nerfro.dashboard", f"outputs={outputs}", "port=0", "open=false"]
    links = tmp_path / "tmp"
    links.mkdir()
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(links)},
        # A shell's background jobs, the tests among them, ignore what is sent below.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"2 runs below .* on (http://\S+/)", line)
        assert found, line
        shown: list[str] = []
        for _ in range(60):
            with urllib.request.urlopen(f"{found[1]}data/runs", timeout=60) as answer:
                shown = json.load(answer)
            if len(shown) == 2:
                break
            time.sleep(0.5)
        assert sorted(shown) == NAMES
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(60)
    assert process.returncode == 130
    assert not list(links.glob("nerfro_dashboard_*"))
