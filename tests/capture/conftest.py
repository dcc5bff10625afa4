"""Entry points of capture, run in the tests' process."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable

import pytest


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run `nerfro.<name>` with overrides; returns what it printed, or its one line of error."""

    def run(name: str, *overrides: str) -> str:
        module = importlib.import_module(f"nerfro.{name}")
        monkeypatch.setattr(sys, "argv", [f"nerfro.{name}", *overrides])
        monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
        capsys.readouterr()
        code: object = None
        try:
            module.main()
        except SystemExit as end:
            code = end.code
        printed = capsys.readouterr()
        if code is None:
            return printed.out
        assert code == 1
        # Progress bars start with a carriage return.
        message = [line for line in printed.err.split("\n") if line and not line.startswith("\r")]
        assert len(message) == 1
        assert message[0].startswith("nerfro: error: ")
        return f"{message[0]}\n"

    return run
