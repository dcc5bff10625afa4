"""`python -m nerfro` and the console script `nerfro` list the commands, and run them as `python -m nerfro.NAME`."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import nerfro.plugins
from nerfro.paths import PACKAGE_DIR

COMMANDS = {file.stem for file in PACKAGE_DIR.glob("*.py") if "\n@entry_point" in file.read_text()} | {
    "demo",
    "plugins",
}


def run(*command: str | Path, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *command], cwd=folder, capture_output=True, text=True, timeout=300)


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """The console script, as pip writes it from pyproject.toml."""
    project = (PACKAGE_DIR.parent / "pyproject.toml").read_text()
    named = re.search(r'^nerfro = "([\w.]+):(\w+)"$', project, re.MULTILINE)
    assert named
    path = tmp_path / "nerfro"
    path.write_text(f"import sys\nfrom {named[1]} import {named[2]}\nsys.exit({named[2]}())\n")
    return path


def test_every_command_is_listed_in_one_line() -> None:
    listed = run("-m", "nerfro")
    lines = [line.split(maxsplit=1) for line in listed.stdout.splitlines()[2:-2]]
    assert {name for name, _ in lines} == COMMANDS, listed.stderr
    assert all(len(purpose) > 15 and purpose.endswith(".") for _, purpose in lines)
    assert listed.returncode == 0


def test_an_unknown_command_is_refused_in_one_line(script: Path) -> None:
    refused = run(script, "trian")
    assert refused.returncode == 1
    assert refused.stderr.startswith("nerfro: error: there is no command 'trian'; choose one of calibrate, ")
    assert refused.stderr.count("\n") == 1


def test_arguments_reach_the_command_and_its_status_comes_back(
    script: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["nerfro.plugins", "loss=smoothness"])
    nerfro.plugins.main()
    # Word by word: lines are as wide as each one's terminal.
    assert run(script, "plugins", "loss=smoothness").stdout.split() == capsys.readouterr().out.split()
    refused = run("-m", "nerfro", "train", "sed=1")
    assert refused.returncode == 1
    assert "sed" in refused.stderr


def test_the_recorded_command_of_a_script_repeats_the_run(script: Path, tiny_run: list[str], tmp_path: Path) -> None:
    options = [*tiny_run, "trainer.max_steps=1", f"hydra.run.dir={tmp_path / 'run'}"]
    done = run(script, "train", *options, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    command = shlex.split(json.loads((tmp_path / "run" / "run.json").read_text())["command"])
    assert command[1:] == ["-m", "nerfro.train", *options]
