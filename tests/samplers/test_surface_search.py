import math

import pytest

from nerfro.samplers.paths.surface_search_cpu import end_of_blocks


@pytest.mark.parametrize("x", [20.0, 20.5, 21.0, 21.0 + 1e-9])
def test_line_along_a_face_leaves_its_blocks_at_their_other_end(x: float) -> None:
    # The last of 21 blocks along x: its face is at 21, where a position may lie by rounding.
    lengths = math.inf, math.inf, 2.0
    assert end_of_blocks(20, 3, 3, 1, x, 3.5, 3.5, *lengths) == pytest.approx(1.0)
    assert end_of_blocks(20, 3, 3, 2, x, 3.5, 3.5, *lengths) == pytest.approx(3.0)


def test_blocks_end_at_the_nearest_side() -> None:
    assert end_of_blocks(2, 2, 2, 1, 2.5, 2.25, 2.5, 1.0, -1.0, 10.0) == pytest.approx(0.25)
