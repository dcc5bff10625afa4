"""What all tests share."""

from __future__ import annotations

import os

import pytest
import torch

# Workers of pytest-xdist share the cores; threads that wait for each other by spinning would slow all of them down.
if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)
