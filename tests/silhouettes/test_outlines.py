"""Cameras move until a known surface is seen in its masks."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh

from benchmarks.cameras import disturbed
from nerfro.cameras import Cameras
from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.visual_hull import Silhouettes
from tests.ball_photographs import NUM_VIEWS, RADIUS, SIZE, cameras, soft_masks
from tests.camera.refined_cameras import PriorInformation, RefinedCamera, align_to_outlines
from tests.conftest import refused

TRUE = cameras()


def ellipsoid() -> TriangleMesh:
    made = trimesh.creation.icosphere(4, RADIUS)
    return TriangleMesh(made.vertices * [1.0, 0.75, 0.55], made.faces)


def silhouettes() -> Silhouettes:
    return Silhouettes.of(TRUE, soft_masks(ellipsoid()))


def met(camera: RefinedCamera, given: Cameras, seen: Silhouettes, sure: list[int] | None = None) -> PriorInformation:
    """Move cameras; some of the six numbers of each are known to be right."""
    camera.begin(given)
    surely = torch.zeros_like(camera.motions.motion)
    surely[:, sure or []] = 1e6
    information = torch.nn.functional.pad(surely.flatten(), (0, len(camera.numbers()) - surely.numel())).diag()
    known = [PriorInformation(camera.numbers(), information)]
    told = align_to_outlines(camera, given, lambda cameras: cameras, seen, ellipsoid(), known)
    assert told is not None
    return told


def pixels_off(given: Cameras) -> float:
    """How far from their right places points of the surface are seen, median."""
    points = torch.from_numpy(ellipsoid().vertices[::20]).float()
    return float((given.project(points)[0] - TRUE.project(points)[0]).norm(dim=-1).median())


@pytest.mark.parametrize("too_wide", [0.0, 0.4])
def test_disturbed_cameras_see_the_surface_where_it_is(too_wide: float) -> None:
    """From half a degree and 1 %, also where all masks are too wide by less than half a pixel."""
    given = replace(TRUE, camera_to_world=disturbed(TRUE, math.radians(0.5), 0.01, 0).float())
    camera, seen = RefinedCamera(), silhouettes()
    met(camera, given, replace(seen, distances=seen.distances + too_wide))
    assert pixels_off(camera.estimated(given)) < 0.15 * pixels_off(given)


def test_cameras_stay_where_the_surface_is_another(capsys: pytest.CaptureFixture[str]) -> None:
    camera = RefinedCamera()
    camera.begin(TRUE)
    other = TriangleMesh(ellipsoid().vertices[:, [1, 0, 2]], ellipsoid().faces[:, ::-1])
    assert align_to_outlines(camera, TRUE, lambda cameras: cameras, silhouettes(), other) is None
    assert not bool(camera.motions.motion.any())
    assert "pixels off its masks" in capsys.readouterr().out


def test_masks_of_nothing_are_refused() -> None:
    camera = RefinedCamera()
    camera.begin(TRUE)
    nothing = Silhouettes.of(TRUE, torch.zeros(NUM_VIEWS, SIZE, SIZE))
    refused("belong together", align_to_outlines, camera, TRUE, lambda cameras: cameras, nothing, ellipsoid())


def test_the_shared_lens_is_found_where_cameras_are_known() -> None:
    given = replace(TRUE, cx=TRUE.cx + 0.4, cy=TRUE.cy - 0.3)
    camera = RefinedCamera(lens=True)
    met(camera, given, silhouettes(), [0, 1, 2, 3, 4, 5])
    found = camera.estimated(given)
    assert float(found.cx[0]) == pytest.approx(float(TRUE.cx[0]), abs=0.03)
    assert float(found.cy[0]) == pytest.approx(float(TRUE.cy[0]), abs=0.03)


def test_shifts_are_told_apart_from_turns_hardly() -> None:
    """A pixel to the side is known to hundredths; a turn that undoes it leaves little to see."""
    camera = RefinedCamera()
    told = met(camera, TRUE, silhouettes())
    assert pixels_off(camera.estimated(TRUE)) < 0.05
    of_view = torch.stack([told.information[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] for v in range(NUM_VIEWS)])
    assert torch.equal(of_view, of_view.mT) or torch.allclose(of_view, of_view.mT, rtol=1e-3)
    # About y a turn to the left, along x a shift to the right.
    aside, undone = torch.tensor([0.0, 0, 0, 1, 0, 0]), torch.tensor([0.0, 1, 0, 1, 0, 0])
    other = torch.tensor([0.0, -1, 0, 1, 0, 0])
    known = of_view @ aside @ aside
    assert float(known.median()) > 1 / 0.05**2
    assert float((torch.minimum(*(of_view @ motion @ motion for motion in (undone, other))) / known).max()) < 0.1
