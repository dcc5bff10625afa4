"""Water surfaces, tanks and windows: the media of the guide against closed forms, and trainings in miniature."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nerfro
from benchmarks.water import SCENES, VIEWS, media_of_the_guide, misses, synthesize_scene, write_scene
from nerfro.media.body_settings import make_bodies
from nerfro.synthetic.gltf_scene import GltfScene
from tests.conftest import SMALL, Runner

MEDIA = media_of_the_guide()


def incident(degrees: float, point: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return a ray in the xz plane that would meet a point if it were straight, at an angle to the vertical."""
    direction = np.array([np.sin(np.radians(degrees)), 0, -np.cos(np.radians(degrees))])
    return np.array(point) - 2 * direction, direction


def test_point_in_a_pool_is_seen_at_its_apparent_place() -> None:
    medium = make_bodies(bodies=MEDIA["pool"], cache=False)
    for degrees in (0.0, 30.0, 60.0):
        origin, direction = incident(degrees, (0.1, 0.0, 0.0))
        (path,) = nerfro.polylines(medium, [origin], [direction], interface="mesh")
        refracted = np.arcsin(np.sin(np.radians(degrees)) / 1.333)
        # Half a metre below the surface
        step = path[2] - path[1]
        at = path[1] + step * (-0.5 - path[1, 2]) / step[2]
        np.testing.assert_allclose(at, [0.1 + 0.5 * np.tan(refracted), 0, -0.5], atol=1e-6)


def test_pane_shifts_rays_without_turning_them_up_to_its_edges() -> None:
    medium = make_bodies(bodies=MEDIA["pane"], resolution=192, cache=False)
    angle = np.radians(40)
    direction = np.array([0, np.cos(angle), np.sin(angle)])
    shift = 0.008 * np.sin(angle) * (1 - np.cos(angle) / np.sqrt(1.52**2 - np.sin(angle) ** 2))
    for x in (0.0, 0.45, 0.4999):
        origin = np.array([x, -1.0, -np.tan(angle)])
        (path,) = nerfro.polylines(medium, [origin], [direction], interface="mesh")
        leaving = (path[-1] - path[-2]) / np.linalg.norm(path[-1] - path[-2])
        np.testing.assert_allclose(leaving, direction, atol=1e-5)
        assert np.linalg.norm(np.cross(path[-1] - origin, direction)) == pytest.approx(shift, rel=1e-2)


def test_thin_pane_gets_a_finer_grid(capsys: pytest.CaptureFixture[str]) -> None:
    pane = {"surface": {"name": "box", "sides": [1.0, 1.0, 0.02]}, "ior": 1.5}
    (grid,) = make_bodies(bodies={"pane": pane}, cache=False).grids
    assert 0.02 / float(grid.spacing.max()) >= 4.9
    assert "the grid of pane has" in capsys.readouterr().out


def test_straight_rays_miss_the_content_behind_water() -> None:
    assert VIEWS.keys() <= MEDIA.keys()
    median = {name: np.median(misses(name, MEDIA[name], 50)) for name in ("tank", "case")}
    assert median["tank"] > 0.01
    assert median["case"] < 0.003


@pytest.mark.slow
@pytest.mark.parametrize("name", MEDIA)
def test_media_of_the_guide_train(name: str, tiny_default_run: list[str], train_here: Runner, tmp_path: Path) -> None:
    def enlarged(value: Any) -> Any:  # the cameras of the tiny scene are four units away
        if isinstance(value, dict):
            return {key: entry if key == "ior" else enlarged(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [enlarged(entry) for entry in value]
        return 2 * value if isinstance(value, float | int) else value

    bodies = str(enlarged(MEDIA[name])).replace("'", "")
    box = ["content.box_min=[-0.8,-0.8,-0.8]", "content.box_max=[0.8,0.8,0.8]"]
    grid = "medium.resolution=192" if name == "pane" else "medium.resolution=32"
    options = f"bodies={bodies}", *box, grid, "trainer.max_steps=2", f"hydra.run.dir={tmp_path}"
    train_here(*tiny_default_run, *options)
    assert (tmp_path / "metrics.json").is_file()


@pytest.mark.parametrize("name", SCENES)
def test_bodies_of_synthesized_scenes_are_nested(name: str, tmp_path: Path) -> None:
    write_scene(name, tmp_path / "scene.glb")
    bodies, contents = SCENES[name]
    parts = GltfScene(tmp_path / "scene.glb").parts
    indices = [ior for _, ior in bodies.values()]
    assert [part.ior for part in parts if part.ior is not None] == indices
    assert [part.outer_ior for part in parts if part.ior is not None] == [1.0, *indices[:-1]]
    assert [part.outer_ior for part in parts if part.ior is None] == [indices[-1]] * len(contents)


@pytest.mark.slow
@pytest.mark.usefixtures("mitsuba")
@pytest.mark.parametrize("name", SCENES)
def test_synthesized_scenes_train(name: str, train_here: Runner, tmp_path: Path) -> None:
    data = synthesize_scene(name, tmp_path / "data", pixels=16, spp=2, num_views=2)
    options = "trainer.max_steps=2", f"hydra.run.dir={tmp_path / 'run'}"
    train_here(f"scene={data / 'scene.json'}", *SMALL, *options)
    assert (tmp_path / "run" / "metrics.json").is_file()
