"""Entry points of capture, run in the tests' process."""

from collections.abc import Callable

import pytest


@pytest.fixture
def command(run_here: Callable) -> Callable[..., str]:
    """Run `nerfro.<name>` with overrides; returns what it printed, or its one line of error."""

    def run(name: str, *overrides: str) -> str:
        code, printed, errors = run_here(name, *overrides)
        if code == 0:
            return printed
        assert code == 1
        # Progress bars start with a carriage return.
        message = [line for line in errors.split("\n") if line and not line.startswith("\r")]
        assert len(message) == 1
        assert message[0].startswith("nerfro: error: ")
        return f"{message[0]}\n"

    return run
