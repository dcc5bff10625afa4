"""Bodies of revolution from their masks: a partly hidden glass, and bodies without an axis."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import gaussian_filter

from nerfro.core.cameras import Cameras
from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes import surface
from nerfro.silhouettes.revolution import fit_revolution
from nerfro.silhouettes.silhouettes import mesh_silhouettes
from nerfro.silhouettes.surface import make_mesh
from nerfro.silhouettes.visual_hull import Silhouettes
from tests.cameras_at import upright_cameras
from tests.exact_silhouettes import volume

SIZE, VIEWS, SHIFT = 160, 16, np.array([0.05, -0.03, -0.6])
TURN = trimesh.transformations.rotation_matrix(0.6, [0.5, -0.8, 0.2])[:3, :3]  # of the axis


def _cameras() -> Cameras:
    """Around the axis, 20 to 50 degrees above the foot."""
    elevation = 20 + 15 * (np.arange(VIEWS) % 3)
    return upright_cameras(VIEWS, SIZE, 2 * SIZE, elevation, world=TURN, near=0.1, far=9.0)


def _body(outline: list[list[float]]) -> TriangleMesh:
    body = trimesh.creation.revolve(np.array(outline), sections=96)
    return TriangleMesh((body.vertices + SHIFT) @ TURN.T, np.asarray(body.faces))


def _glass() -> TriangleMesh:
    return _body([[0, 0], [0.3, 0], [0.3, 0.15], [0.22, 0.3], [0.45, 1.2], [0, 1.2]])


def _masks(mesh: TriangleMesh, cameras: Cameras) -> torch.Tensor:
    return mesh_silhouettes(mesh, cameras, 1).float()


def test_revolution_fit_recovers_a_glass_with_a_partly_hidden_foot() -> None:
    cameras, glass = _cameras(), _glass()
    masks = _masks(glass, cameras)
    seen = masks.clone()
    seen[:3, 105:] = 0  # something stands before the foot
    silhouettes = Silhouettes.of(cameras, seen)
    hull = make_mesh(silhouettes, None, 48, 3, None, 0.0)
    found = fit_revolution(hull, silhouettes)
    inside = mesh_silhouettes(found, cameras, 1)
    overlap = ((inside & (masks > 0)).sum((1, 2)) / (inside | (masks > 0)).sum((1, 2))).numpy()
    assert overlap.min() > 0.97
    assert found.is_closed
    assert volume(found) > 0, "faces look outwards"
    # As wide as it is, at the brim and around the foot, and as high.
    points = found.vertices @ TURN - SHIFT
    radius = np.linalg.norm(points[:, :2], axis=1)
    assert points[:, 2].min() == pytest.approx(0, abs=0.03)  # hardly any camera sees a low cone below the foot
    assert points[:, 2].max() == pytest.approx(1.2, abs=0.04)
    assert radius[np.abs(points[:, 2] - 0.7) < 0.03].max() == pytest.approx(0.322, abs=0.015)
    assert radius.max() == pytest.approx(0.45, abs=0.02)


def test_sharp_edges_are_recovered_to_a_sixth_of_a_pixel() -> None:
    elevation, height, pixel = 12 + 15 * (np.arange(VIEWS) % 3), 0.9, 4 / (2 * SIZE)
    cameras = upright_cameras(VIEWS, SIZE, 2 * SIZE, elevation, world=TURN, near=0.1, far=9.0)
    drum = _body([[0, 0], [0.35, 0], [0.42, height], [0, height]])
    silhouettes = Silhouettes.of(cameras, _masks(drum, cameras))
    found = fit_revolution(make_mesh(silhouettes, None, 48, 0, None, 0.0), silhouettes)
    assert found is not None
    points = found.vertices @ TURN - SHIFT
    assert points[:, 2].min() == pytest.approx(0, abs=pixel / 6)
    assert points[:, 2].max() == pytest.approx(height, abs=pixel / 6)
    assert np.linalg.norm(points[:, :2], axis=1).max() == pytest.approx(0.42, abs=pixel / 6)


@pytest.mark.parametrize(
    "outline",
    [
        pytest.param([[0, 0], [0.35, 0], [0.42, 0.9], [0, 0.9]], id="flat foot"),
        pytest.param([[0, 0], [0.1, 0], [0.4, 0.25], [0.42, 0.9], [0, 0.9]], id="conical foot"),
    ],
)
def test_ends_are_found_in_noisy_masks(outline: list[list[float]]) -> None:
    elevation, pixel, random = 12 + 15 * (np.arange(VIEWS) % 3), 4 / (2 * SIZE), np.random.default_rng(0)
    cameras = upright_cameras(VIEWS, SIZE, 2 * SIZE, elevation, world=TURN, near=0.1, far=9.0)
    distances = Silhouettes.of(cameras, _masks(_body(outline), cameras)).distances.numpy()
    noise = np.stack([gaussian_filter(random.normal(size=(SIZE, SIZE)), 4) for _ in range(VIEWS)])
    masks = torch.from_numpy(distances + noise / noise.std() > 0).float()  # one pixel
    silhouettes = Silhouettes.of(cameras, masks)
    found = fit_revolution(make_mesh(silhouettes, None, 48, 0, None, 0.0), silhouettes)
    assert found is not None
    heights = found.vertices @ TURN[:, 2] - SHIFT[2]
    assert heights.min() == pytest.approx(0, abs=2.5 * pixel)
    assert heights.max() == pytest.approx(0.9, abs=2.5 * pixel)


def test_box_is_no_body_of_revolution(capsys: pytest.CaptureFixture[str]) -> None:
    cameras = _cameras()
    box = trimesh.creation.box([0.9, 0.3, 1.2])
    mesh = TriangleMesh(np.asarray(box.vertices) @ TURN.T, np.asarray(box.faces))
    silhouettes = Silhouettes.of(cameras, _masks(mesh, cameras))
    for symmetry, message in (("axis", "symmetry=axis is ignored"), ("auto", "as a body of revolution")):
        found = make_mesh(silhouettes, None, 32, 0, None, 0.0, symmetry)  # type: ignore[arg-type]
        assert message in capsys.readouterr().out
        sides = np.sort(np.ptp(found.vertices @ TURN, axis=0))
        assert sides == pytest.approx([0.3, 0.9, 1.2], abs=0.15)


@pytest.mark.slow
def test_bodies_of_revolution_are_detected_by_their_masks(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = _cameras()
    masks = _masks(_glass(), cameras)
    masks[:3, 105:] = 0  # something stands before the foot
    silhouettes = Silhouettes.of(cameras, masks)

    def unevenness(symmetry: str | None, smoothing: float = 0.0, is_revolution: bool = False) -> float:
        """Of the radii of the part that is a cone."""
        options = 32, 3, None, smoothing, symmetry, None, is_revolution
        points = make_mesh(silhouettes, None, *options).vertices @ TURN - SHIFT  # type: ignore[arg-type]
        cone = points[np.abs(points[:, 2] - 0.7) < 0.3]
        return float((np.linalg.norm(cone[:, :2], axis=1) - np.interp(cone[:, 2], [0.3, 1.2], [0.22, 0.45])).std())

    assert unevenness("auto") < 0.5 * unevenness(None)
    monkeypatch.setattr(surface, "fit_surface", None)  # is not called for projections of a body of revolution
    assert unevenness("auto", 1.0, True) == unevenness("auto")
