"""A short run of `tests/fuzz/campaign.py` with a few cases of every type."""

import pytest

from tests.fuzz.campaign import run_case
from tests.fuzz.cases import KINDS
from tests.fuzz.world import World

_NUM_CASES = {"data_formats": 60, "single_files": 60, "checkpoints": 20}  # the others are commands, of which 8 are run


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_broken_inputs_are_refused_in_one_line(kind: str, world: World) -> None:
    for number in range(_NUM_CASES.get(kind, 8)):
        assert run_case(world, kind, 0, number) is None, number
