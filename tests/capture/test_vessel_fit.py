"""The lengths of a glass from its pixels under a sky in closed form."""

from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh
from torch import Tensor

from nerfro.boundaries.base import Boundary
from nerfro.capture.surroundings import Observations, Pixels, Surroundings
from nerfro.capture.vessel_fit import fit_vessel
from nerfro.data.base import Views
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.vessel import SdfVessel
from nerfro.samplers.snell import Snell
from nerfro.subdivision import pixel_rays
from nerfro.types import Exits
from tests.ball_photographs import NUM_VIEWS, SIZE, cameras, sky

RADIUS, HEIGHT, NUM_PIXELS = 0.45, 1.0, 1000
# A larger fillet and a thicker foot have similar effects.
TOLERANCES = {"wall": 0.1, "foot": 0.25, "fillet": 0.25, "level": 0.02}


class Sky(Boundary):
    def forward(self, exits: Exits) -> Tensor:
        return sky(exits.directions)


@pytest.mark.parametrize(
    "lengths",
    [{"wall": 0.025, "foot": 0.1, "fillet": 0.12}, {"wall": 0.025, "foot": 0.1, "fillet": 0.12, "level": 0.64}],
    ids=["empty", "partly filled"],
)
def test_lengths_of_a_glass_are_found_from_ordinary_values(tmp_path: Path, lengths: dict[str, float]) -> None:
    body = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=96)
    body.export(tmp_path / "glass.ply")

    def build(**options: Any) -> SdfVessel:
        box = {"box_min": [-0.7] * 3, "box_max": [0.7] * 3}
        return SdfVessel(str(tmp_path / "glass.ply"), ior=1.52, resolution=64, cache=False, **box, **options)

    glass = build(**lengths, liquid_ior=1.333 if "level" in lengths else 1.0)
    taken, random = cameras(), torch.Generator().manual_seed(0)
    index = torch.randint(NUM_VIEWS * SIZE * SIZE, (8 * NUM_PIXELS,), generator=random)
    index = index[Snell()(pixel_rays(taken, index), glass).refracted][:NUM_PIXELS].sort().values
    path = Snell(branches="all", least_weight=0.02)(pixel_rays(taken, index), glass)
    seen = Pixels(taken, index, path.per_ray(sky(path.exits().directions)).float())
    views = Views(taken, torch.zeros(NUM_VIEWS, SIZE, SIZE, 3), None, [""] * NUM_VIEWS)
    observations = Observations(views, TriangleMesh(body.vertices, body.faces), False)
    known = Surroundings(Sky(), None, 0.0, seen.radiance)  # type: ignore[arg-type]
    observations.__dict__.update(through=seen, surroundings=known)
    found = fit_vessel(build, 2 * RADIUS, observations)
    assert found.lengths.keys() == lengths.keys()
    assert not found.unknown
    for name, length in lengths.items():
        assert found.lengths[name] == pytest.approx(length, rel=TOLERANCES[name])
        assert 0 < found.standard_errors[name] < 0.1 * length
