"""The lengths of a glass, and the support for bodies, from pixels under a sky in closed form."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from nerfro.backgrounds.base import Background
from nerfro.capture import vessel_fit
from nerfro.capture.object_errors import ObjectErrors, unsupported_bodies
from nerfro.capture.surroundings import Observations, Pixels, Surroundings
from nerfro.capture.vessel_fit import VesselFit, VesselFitSettings, find_vessel, fit_vessel, stem_height
from nerfro.core.types import Exits
from nerfro.data.base import Views
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.media.bodies import Bodies, GridSettings
from nerfro.media.body_settings import make_bodies
from nerfro.media.material import Material
from nerfro.media.surfaces import MeshSurface
from nerfro.media.vessel import VesselLengths, make_vessel, vessel
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.subdivision import pixel_rays
from tests.ball_photographs import NUM_VIEWS, SIZE, cameras, sky
from tests.ball_photographs import mesh as ball
from tests.conftest import refused

RADIUS, HEIGHT, NUM_PIXELS = 0.45, 1.0, 1000
# A larger fillet and a thicker foot have similar effects.
TOLERANCES = {"wall": 0.1, "foot": 0.25, "fillet": 0.25, "level": 0.02}


class Sky(Background):
    def forward(self, exits: Exits) -> Tensor:
        return sky(exits.directions)


BOX: dict[str, Any] = {"box_min": [-0.7] * 3, "box_max": [0.7] * 3, "resolution": 64, "cache": False}


@pytest.fixture
def cylinder(tmp_path: Path) -> Path:
    trimesh.creation.cylinder(RADIUS, HEIGHT, sections=96).export(tmp_path / "glass.ply")
    return tmp_path / "glass.ply"


def vessels_in(cylinder: Path) -> Callable[[VesselLengths], Bodies]:
    """Return a function that builds vessels of lengths within the cylinder, with water if they have a level."""
    outer, grid = MeshSurface(str(cylinder)), GridSettings(**BOX)

    def build(lengths: VesselLengths) -> Bodies:
        liquid = None if lengths.level is None else Material(1.333)
        return vessel(outer, lengths, Material(1.52), liquid, grid=grid)

    return build


def observed(cylinder: Path, glass: Bodies) -> Observations:
    """Observe a body through pixels of its silhouette, with all reflections."""
    taken, random = cameras(), torch.Generator().manual_seed(0)
    index = torch.randint(NUM_VIEWS * SIZE * SIZE, (8 * NUM_PIXELS,), generator=random)
    silhouette = Snell()(pixel_rays(taken, index), make_bodies(str(cylinder), **BOX)).refracted
    index = index[silhouette][:NUM_PIXELS].sort().values
    path = Snell(branches="all", least_weight=0.02)(pixel_rays(taken, index), glass)
    seen = Pixels(taken, index, path.sum_polylines(sky(path.exits().directions)).float())
    views = Views(taken, torch.zeros(NUM_VIEWS, SIZE, SIZE, 3), None, [""] * NUM_VIEWS)
    observations = Observations(views, load_mesh(cylinder), False)
    known = Surroundings(Sky(), None, 0.0, seen.radiance)  # type: ignore[arg-type]
    observations.__dict__.update(through=seen, surroundings=known)
    return observations


@pytest.mark.slow
@pytest.mark.parametrize(
    "lengths",
    [{"wall": 0.025, "foot": 0.1, "fillet": 0.12}, {"wall": 0.025, "foot": 0.1, "fillet": 0.12, "level": 0.64}],
    ids=["empty", "partly filled"],
)
def test_vessel_fit_recovers_lengths_from_default_values(cylinder: Path, lengths: dict[str, float]) -> None:
    build = vessels_in(cylinder)
    glass = build(VesselLengths(**lengths))
    found = fit_vessel(build, 2 * RADIUS, HEIGHT, observed(cylinder, glass))
    assert found.lengths.keys() == lengths.keys()
    assert not found.unknown
    for name, length in lengths.items():
        assert found.lengths[name] == pytest.approx(length, rel=TOLERANCES[name])
        assert 0 < found.standard_errors[name] < 0.1 * length


@pytest.mark.parametrize(("ior", "supported"), [(1.0, []), (1.333, ["solid body, water"]), (None, ["vessel"])])
def test_pixels_support_the_body_that_refracts_their_rays(
    cylinder: Path, ior: float | None, supported: list[str]
) -> None:
    solid = make_bodies(str(cylinder), ior=ior or 1.5, **BOX)
    filled = make_vessel(str(cylinder), wall=0.05, level=0.6, **BOX)
    observations = observed(cylinder, solid if ior else filled)
    found = {"solid body, water", "solid body, glass", "vessel"}.difference(
        unsupported_bodies(observations, solid, True, filled)
    )
    assert found == set(supported)
    assert unsupported_bodies(observations, solid, False, None) == ([] if ior == 1.333 else ["solid body"])
    observations.__dict__["through"] = observations.through[observations.through.view < 4]
    assert unsupported_bodies(observations, solid, False, None) == ["solid body"], "no decrease is significant"


@pytest.mark.parametrize(
    ("radii", "expected"),
    [
        ([0.35, 0.35, 0.05, 0.05, 0.05, 0.4, 0.4, 0.35], 0.57),  # foot, stem and bowl
        ([0.3, 0.3, 0.3, 0.25, 0.06, 0.06, 0.06, 0.06], 0.0),  # a bottle with a narrow neck
        ([0.4, 0.35, 0.25, 0.2, 0.2, 0.25, 0.35, 0.4], 0.0),  # a waist
        ([0.3, 0.4], 0.0),  # a tumbler of few triangles
    ],
)
def test_stem_is_a_narrow_part_between_two_wide_ones(radii: list[float], expected: float) -> None:
    outline = np.column_stack([radii, np.linspace(0, 1, len(radii))])
    shape = trimesh.creation.revolve(np.vstack([[0, 0], outline, [0, 1]]))
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    assert stem_height(mesh, np.array([0.0, 0.0, 1.0])) == pytest.approx(expected, abs=0.06)


def test_parts_above_each_other_are_no_vessel() -> None:
    balls = [trimesh.creation.icosphere(2, 0.3), trimesh.creation.icosphere(2, 0.2).apply_translation((0, 0, 0.9))]
    shape = trimesh.util.concatenate(balls)
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    refused("separate parts above each other", stem_height, mesh, np.array([0.0, 0.0, 1.0]))


def test_cavity_does_not_continue_into_a_stem(cylinder: Path) -> None:
    """The best foot would be lower than the stem, and then the foot ends with the stem."""
    build = vessels_in(cylinder)
    observations = observed(cylinder, build(VesselLengths(wall=0.025, foot=0.2, fillet=0.12)))
    settings = VesselFitSettings(levels=(), rounds=((2.0, 0.1),), num_candidates=3)
    found = fit_vessel(build, 2 * RADIUS, HEIGHT, observations, stem=0.4, settings=settings)
    assert found.lengths["foot"] == pytest.approx(0.4)


@pytest.mark.parametrize("stem", [0.0, 0.12])
def test_candidates_stay_within_the_limits_of_lengths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stem: float
) -> None:
    """The errors of a shallow bowl are smallest for a larger fillet, and for a level below the foot."""
    best = {"wall": 0.02, "foot": 0.2, "fillet": 0.8, "level": 0.05}
    tried: list[VesselLengths] = []

    class Errors(ObjectErrors):
        def __init__(self, *_: object) -> None:
            self.counts, self.samples = np.full(8, 10.0), np.ones((3, 8))

        def of(self, medium: Bodies) -> np.ndarray:
            lengths = medium.grids[1].lengths
            assert isinstance(lengths, VesselLengths)
            tried.append(lengths)
            off = [
                abs(np.log(getattr(lengths, name) / value)) for name, value in best.items() if getattr(lengths, name)
            ]
            return np.full(8, np.sum(off) + 9 * (lengths.level is None))

        def mean(self, errors: np.ndarray) -> float:
            return float(errors.mean())

        def decreases(self, before: np.ndarray, after: np.ndarray, num_errors: float) -> bool:
            return bool(after.mean() < before.mean())

    monkeypatch.setattr(vessel_fit, "ObjectErrors", Errors)
    height = 0.3
    trimesh.creation.cylinder(0.5, height).export(tmp_path / "bowl.ply")
    build = vessels_in(tmp_path / "bowl.ply")
    observations = Observations(Views(cameras(), torch.zeros(NUM_VIEWS, 1, 1, 3), None, []), ball(), False)
    found = fit_vessel(build, 1.0, height, observations, stem)
    for lengths in tried:
        lengths.require_within(height)
        assert lengths.fillet <= VesselFitSettings.max_fillet * (1 + 1e-9)
    assert found.lengths["fillet"] == pytest.approx(VesselFitSettings.max_fillet)
    assert found.lengths["foot"] < found.lengths["level"]
    build(VesselLengths(**{name: float(f"{length:.4g}") for name, length in found.lengths.items()}))


def test_options_of_the_surface_apply_to_the_vessel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=32)
    shape.update_faces(np.arange(len(shape.faces)) > 0)  # open
    shape.export(tmp_path / "glass.ply")
    lengths = {"wall": 0.05, "foot": 0.1, "fillet": 0.1}
    monkeypatch.setattr(vessel_fit, "fit_vessel", lambda *_: VesselFit(lengths, dict.fromkeys(lengths, 0.0), []))
    settings = BOX | {"mesh": str(tmp_path / "glass.ply"), "accept_open_mesh": True, "crease_degrees": 80.0}
    solid, mesh = make_bodies(**settings), load_mesh(tmp_path / "glass.ply", accept_open_mesh=True)
    observations = Observations(Views(cameras(), torch.zeros(NUM_VIEWS, 1, 1, 3), None, []), mesh, False)
    fitted = find_vessel(solid, settings, mesh, observations)[1]
    assert fitted is not None
    torch.testing.assert_close(fitted.grids[0].distances, solid.grids[0].distances, rtol=0, atol=0)


@pytest.mark.parametrize(("factor", "unknown"), [(1.0, ["wall", "foot", "fillet"]), (2.0, [])])
def test_uncertain_lengths_are_kept_if_they_explain_the_pixels_better(
    cylinder: Path, factor: float, unknown: list[str]
) -> None:
    build = vessels_in(cylinder)
    settings = VesselFitSettings(levels=(), rounds=((2.0, 0.1),), num_candidates=3, max_standard_error=0.0)
    typical = {name: 2 * RADIUS * getattr(settings, name) for name in ("wall", "foot", "fillet")}
    lengths = {name: factor * length for name, length in typical.items()}
    observations = observed(cylinder, build(VesselLengths(**lengths)))
    found = fit_vessel(build, 2 * RADIUS, HEIGHT, observations, settings=settings)
    assert found.unknown == unknown
    assert found.lengths == pytest.approx(lengths, rel=1e-6 if factor == 1 else 0.3)
