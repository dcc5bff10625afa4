"""Paths in arc length."""

import torch

from nerfro.testing import example_path

BOX = torch.tensor([[-0.5, -0.7, -0.4], [0.6, 0.5, 0.7]])


def test_span_holds_just_what_is_inside_the_box() -> None:
    path = example_path(64)
    first, last = path.span(BOX)
    s = torch.linspace(2.0, 6.0, 4001).expand(64, -1).contiguous()
    positions, _ = path.at(s)
    inside = ((positions > BOX[0]) & (positions < BOX[1])).all(-1)
    assert 10 < inside.any(-1).sum() < 60
    for ray in range(64):
        if not inside[ray].any():
            continue
        seen = s[ray][inside[ray]]
        assert abs(seen.min() - first[ray]) < 2e-3
        assert abs(seen.max() - last[ray]) < 2e-3
