"""`python -m nerfro.preprocess`: its files, the command that it prints, and refused options."""

import json
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from nerfro.capture import refinement
from nerfro.capture.preprocess_options import _ray_bounds
from nerfro.capture.refinement import DescentStage, RefinementSettings
from nerfro.data.base import Frame, Views
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.masks.mask_files import save_mask
from nerfro.media.body_settings import BodySettings
from nerfro.rendering.scene_file import read_scene_file
from nerfro.silhouettes.silhouettes import mesh_silhouettes
from tests.ball_photographs import NUM_VIEWS, RADIUS, SIZE, cameras, mesh, photographs, save
from tests.cameras_at import cameras_at
from tests.conftest import UTM


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A Blender-format folder of grey views of a ball, with binary masks in masks/train/."""
    root = tmp_path / "capture"
    grey = torch.full((NUM_VIEWS, SIZE, SIZE, 3), 0.5)
    save(Views(cameras(), grey, None, [str(view) for view in range(NUM_VIEWS)]), root)
    (root / "mesh.ply").unlink()
    (root / "masks" / "train").mkdir(parents=True)
    for view, mask in enumerate(mesh_silhouettes(mesh(), cameras(), 1)):
        Image.fromarray(np.uint8(255 * mask)).save(root / "masks" / "train" / f"r_{view}.png")
    return root


def radii(capture: Path) -> np.ndarray:
    """Distances of the vertices of the surface from the centre of the ball."""
    return np.linalg.norm(load_mesh(capture / "mesh.ply").vertices, axis=1)


@pytest.fixture
def preprocess(capture: Path, run_here: Callable) -> Callable[..., str]:
    """Run the entry point in this process on the capture; returns what it printed, or its one line of error."""

    def run(*overrides: str) -> str:
        common = [f"data.root={capture}", "medium.resolution=32", "medium.cache=false"]
        common += [] if any(text.startswith("mesh=") for text in overrides) else ["resolution=24"]
        common += [] if any(text.startswith(("medium.ior=", "refine=")) for text in overrides) else ["medium.ior=1.5"]
        done = run_here("preprocess", *common, *overrides, code=None)
        return done.err if done.code else done.out

    return run


def _change_masks(capture: Path, change: Callable[[np.ndarray], np.ndarray], count: int = NUM_VIEWS) -> None:
    for view in range(count):
        path = capture / "masks" / "train" / f"r_{view}.png"
        Image.fromarray(change(np.array(Image.open(path)))).save(path)


@pytest.mark.slow
def test_preprocess_carves_a_ball_from_its_silhouettes(preprocess: Callable[..., str], capture: Path) -> None:
    printed = preprocess("medium.ior=1.33")
    surface = load_mesh(capture / "mesh.ply")
    assert surface.is_closed
    # A pixel is 0.09 wide at the ball, and binary masks have an error of a quarter of a pixel.
    assert abs(radii(capture).mean() - RADIUS) < 0.04
    overlaps = json.loads((capture / "overlaps.json").read_text())
    assert overlaps["mean"] > 0.93
    assert list(overlaps["views"]) == [f"train/r_{view}" for view in range(NUM_VIEWS)]
    assert all(f"train/r_{view}\n" in printed for view in range(NUM_VIEWS))
    with Image.open(capture / "overlays.png") as sheet:
        assert np.array(sheet).std() > 10
    assert f"train on it: python -m nerfro.train scene={capture / 'scene.json'}\n" in printed
    scene = read_scene_file(capture / "scene.json")
    assert scene.data == {"type": "blender", "root": str(capture)}, "the data set's bounds of rays suffice"
    assert scene.bodies == {"object": BodySettings(mesh=str(capture / "mesh.ply"), ior=1.33)}
    assert (np.array(scene.medium["box_min"]) < surface.bounds[0]).all()
    assert (np.array(scene.medium["box_max"]) > surface.bounds[1]).all()
    preprocess("data.near=2.5", "data.far=3.1", "smoothing=0", "overwrite=true")
    narrow = read_scene_file(capture / "scene.json").data
    assert narrow["near"] < 2.3 < 3.7 < narrow["far"], "bounds that cut the object are replaced"


def test_printed_command_trains(
    preprocess: Callable[..., str], train_here: Callable, tiny_default_run: list[str]
) -> None:
    command = shlex.split(preprocess("smoothing=0").split("train on it: ")[1])[3:]
    small = [text for text in tiny_default_run if not text.startswith(("data.root=", "medium."))]
    trained = train_here(*small, *command, "trainer.max_steps=1", "evaluation.split=train", "evaluation.every=0")
    assert "1 steps in" in trained.out


def test_vessel_is_upright_in_a_world_with_another_z_axis(preprocess: Callable[..., str], capture: Path) -> None:
    lengths = ["medium=vessel", "medium.wall=0.1", "medium.level=1.0", "smoothing=0"]
    printed = preprocess(*lengths)
    # The cameras' right-hand axes are perpendicular to it, see `capture`.
    held = np.array([0.3, 0.9, 0.1]) / np.linalg.norm([0.3, 0.9, 0.1])
    scene = read_scene_file(capture / "scene.json")
    assert np.array(scene.medium["up"]) @ held > 0.99
    assert scene.settings()["medium"] == "vessel"
    assert "set medium.up= to change the direction" in printed
    assert "set medium.up=" not in preprocess(*lengths, "medium.up=[0,0,1]", "overwrite=true")


def test_body_of_revolution_is_fitted_on_request(preprocess: Callable[..., str], capture: Path) -> None:
    assert "as a body of revolution" in preprocess("medium.ior=1.33", "symmetry=axis", "smoothing=0")
    assert abs(radii(capture).mean() - RADIUS) < 0.06


@pytest.mark.slow
def test_vessel_is_fitted_on_request(preprocess: Callable[..., str], capture: Path) -> None:
    printed = preprocess("medium.ior=1.33", "smoothing=0", "vessel=true", "room=false", "data.downscale=2")
    command = shlex.split(printed.split("train on the vessel: ")[1])
    assert command[3:] == [f"scene={capture / 'scene.json'}", "medium=vessel"]
    scene = read_scene_file(capture / "scene.json")
    assert (scene.settings()["medium.ior"], scene.settings(medium="vessel")["medium.ior"]) == (1.33, 1.52)
    line = next(line for line in printed.splitlines() if line.startswith("vessel, "))
    shown = {name: float(value) for name, value in re.findall(r"(wall|foot|fillet|level) ([\d.]+)", line)}
    lengths = {name: scene.vessel[name] for name in shown}
    assert lengths == pytest.approx(shown, rel=0.005), "the scene file has the lengths that are printed"
    assert ("level" in shown) == (scene.vessel["liquid_ior"] != 1)


def test_existing_files_are_not_overwritten(preprocess: Callable[..., str], capture: Path) -> None:
    for name in ("mesh.ply", "index.json", "refinement.json"):
        (capture / name).write_text("mine")
    assert "mesh.ply exists; give another out=... or overwrite=true" in preprocess()
    assert (capture / "mesh.ply").read_text() == "mine"
    assert "train on it" in preprocess("overwrite=true", "smoothing=0")
    assert load_mesh(capture / "mesh.ply").is_closed
    assert not (capture / "index.json").exists(), "the earlier run searched the index, and this one did not"
    assert not (capture / "refinement.json").exists()


def test_supplied_mesh_is_compared_and_kept(preprocess: Callable[..., str], capture: Path, tmp_path: Path) -> None:
    mesh().save(tmp_path / "my ball.ply")
    printed = preprocess(f"mesh='{tmp_path / 'my ball.ply'}'")
    assert "train on it" in printed
    assert read_scene_file(capture / "scene.json").bodies["object"].mesh == str(tmp_path / "my ball.ply")
    assert not (capture / "mesh.ply").exists()
    assert json.loads((capture / "overlaps.json").read_text())["mean"] > 0.97


def test_report_of_an_earlier_run_is_removed(preprocess: Callable[..., str], capture: Path, tmp_path: Path) -> None:
    mesh().save(tmp_path / "ball.ply")
    shutil.rmtree(capture / "masks")
    for name in ("overlaps.json", "overlays.png"):
        (capture / name).write_text("of masks")
    printed = preprocess(f"mesh={tmp_path / 'ball.ply'}", "overwrite=true")
    assert f"results: {capture / 'scene.json'}\n" in printed
    assert not (capture / "overlaps.json").exists()
    assert not (capture / "overlays.png").exists()


def test_open_mesh_is_accepted_on_request(preprocess: Callable[..., str], tmp_path: Path) -> None:
    ball = mesh()
    TriangleMesh(ball.vertices, ball.faces[1:]).save(tmp_path / "open.ply")
    assert "or set medium.accept_open_mesh=true" in preprocess(f"mesh={tmp_path / 'open.ply'}")
    assert "train on it" in preprocess(f"mesh={tmp_path / 'open.ply'}", "medium.accept_open_mesh=true")


def test_bounds_of_the_rays_contain_a_mesh_of_few_vertices() -> None:
    """The middle of a face is nearer than the corners, and another corner is farther away than the first one."""
    corners = trimesh.creation.box((1.2, 1.2, 1.2))
    cube = TriangleMesh(np.asarray(corners.vertices), np.asarray(corners.faces))
    pose = np.column_stack([np.eye(3), [0, 0, 3.0]])[None]
    nearest, farthest = 3 - 0.6, np.linalg.norm([0.6, 0.6, 3 + 0.6])
    bounds = _ray_bounds(cameras_at(pose, SIZE, SIZE, 50.0, near=nearest + 0.01, far=farthest - 0.01), cube)
    assert bounds == {"near": pytest.approx(0.8 * nearest, rel=0.01), "far": pytest.approx(1.2 * farthest, rel=0.01)}
    assert not _ray_bounds(cameras_at(pose, SIZE, SIZE, 50.0, near=nearest - 0.01, far=farthest + 0.01), cube)


def test_options_of_the_hull_are_refused_beside_a_mesh(preprocess: Callable[..., str], tmp_path: Path) -> None:
    mesh().save(tmp_path / "ball.ply")
    printed = preprocess(f"mesh={tmp_path / 'ball.ply'}", "smoothing=0.5")
    assert "smoothing=0.5 has no effect with mesh=..., which replaces the hull; remove it" in printed
    printed = preprocess(f"mesh={tmp_path / 'ball.ply'}", "box_min=[-1,-1,-1]", "box_max=[1,1,1]")
    assert "box_min=[-1.0, -1.0, -1.0] has no effect with mesh=..." in printed


def test_masks_that_the_border_cuts_are_compared_with_a_mesh(
    preprocess: Callable[..., str], capture: Path, tmp_path: Path
) -> None:
    """Only a hull would be unbounded there."""
    mesh().save(tmp_path / "ball.ply")
    _change_masks(capture, lambda mask: mask[14:-14].copy())
    for view in range(NUM_VIEWS):
        path = capture / "train" / f"r_{view}.png"
        Image.open(path).crop((0, 14, SIZE, SIZE - 14)).save(path)
    printed = preprocess(f"mesh={tmp_path / 'ball.ply'}")
    assert "train on it" in printed


@pytest.mark.slow
def test_index_of_a_named_body_without_material_is_estimated(preprocess: Callable[..., str], capture: Path) -> None:
    save(photographs([1.45]), capture, UTM)
    ball = f"bodies={{ball: {{mesh: {capture / 'mesh.ply'}, absorption: [0.1]}}}}"
    printed = preprocess(f"mesh={capture / 'mesh.ply'}", ball, "room=false", "data.near=0.5")
    assert "index: 1.4" in printed
    found = read_scene_file(capture / "scene.json").bodies["ball"]
    assert found.ior == pytest.approx(1.45, rel=0.01)
    assert found.absorption == [0.1]


@pytest.mark.slow
def test_index_search_and_refinement_work_far_from_the_origin(
    preprocess: Callable[..., str], capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = RefinementSettings((DescentStage(25, 5e-4, (3.0, 1.0)),), 1000, (8,))
    monkeypatch.setattr(refinement, "RefinementSettings", lambda: quick)
    place = 200.0, 0.0, 0.0
    save(photographs([1.45]), capture, place)
    (capture / "mesh.ply").unlink()
    preprocess("room=false", "data.near=0.5", "refine=true", "smoothing=0")
    scene = read_scene_file(capture / "scene.json")
    assert scene.bodies["object"].ior == pytest.approx(1.45, rel=0.03)  # 1.42 at the origin, too
    assert json.loads((capture / "refinement.json").read_text())["validation_error"][0] < 0.2
    for box in (load_mesh(capture / "mesh.ply").bounds, [scene.medium["box_min"], scene.medium["box_max"]]):
        assert np.mean(box, 0) == pytest.approx(place, abs=0.05)


def test_data_without_masks_is_refused(preprocess: Callable[..., str], tiny_scene: Path) -> None:
    options = f"data.root={tiny_scene}", "overwrite=true"
    assert "the data set has no masks" in preprocess(*options)


@pytest.mark.parametrize(
    ("change", "count", "message"),
    [
        (lambda mask: 0 * mask, 1, "train/r_0: the mask is empty"),
        (lambda mask: 255 - mask, NUM_VIEWS, f"{NUM_VIEWS} of {NUM_VIEWS} masks are inverted"),
        (lambda mask: mask[:12], 1, r"r_0\.png has 40x12 pixels but its image has 40x40"),
        (
            lambda mask: np.maximum(mask, 255 * (np.arange(SIZE) < 15)).astype(np.uint8),
            NUM_VIEWS,
            f"border cuts the object in all {NUM_VIEWS}",
        ),
        (lambda mask: np.roll(mask, 20, 1), 1, "check the masks and poses of train/r_0, and .* wrong_masks=1"),
    ],
    ids=["empty", "inverted", "size", "cut", "wrong"],
)
def test_wrong_masks_give_a_one_line_error(
    preprocess: Callable[..., str], capture: Path, change: Callable, count: int, message: str
) -> None:
    _change_masks(capture, change, count)
    printed = preprocess()
    assert re.search(message, printed)
    assert printed.count("\n") == 1
    assert not (capture / "mesh.ply").exists()


def test_views_from_one_side_are_bounded_by_the_box(preprocess: Callable[..., str], capture: Path) -> None:
    file = capture / "transforms_train.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps(document | {"frames": document["frames"][:2]}))
    assert "2 views do not determine a shape" in preprocess()
    file.write_text(json.dumps(document | {"frames": document["frames"][:3]}))
    printed = preprocess("box_min=[-0.9,-0.9,-0.4]", "box_max=[0.9,0.9,0.5]", "smoothing=0")
    assert "3 views give a coarse visual hull" in printed
    assert "cuts the visual hull" in printed
    assert "silhouettes do not bound the object in depth" in printed
    assert load_mesh(capture / "mesh.ply").bounds[1, 2] < 0.6


def test_options_out_of_range_are_refused(preprocess: Callable[..., str]) -> None:
    assert "resolution=8 is not allowed" in preprocess("resolution=8")
    assert "symmetry='plane' is not allowed; choose 'axis', 'auto'" in preprocess("symmetry=plane")
    assert f"wrong_masks={NUM_VIEWS} is not allowed: two of the {NUM_VIEWS} views must" in preprocess("wrong_masks=30")
    assert f"give at most {NUM_VIEWS - 2}," in preprocess("wrong_masks=10000000")
    assert "give both box_min and box_max" in preprocess("box_min=[0,0,0]")
    assert "add out=FOLDER" in preprocess("data.root=embedded:torus")
    assert "set medium=object or medium=vessel" in preprocess("refine=true", "medium=object_voxels")
    assert "bodies.a=3 is not a set of settings" in preprocess("bodies={a: 3}")
    stand = "stand: {mesh: stand.ply, ior: 1.5}"
    for bodies in (f"{{{stand}, ball: {{ior: 1.4}}}}", f"{{ball: {{ior: 1.4, priority: 1}}, {stand}}}"):
        for option in ("refine=true", "vessel=true"):
            assert "first body, which must" in preprocess(f"bodies={bodies}", option)


def test_hull_needs_masks_of_only_some_views(preprocess: Callable[..., str], capture: Path) -> None:
    for view in range(0, NUM_VIEWS, 2):
        (capture / "masks" / "train" / f"r_{view}.png").unlink()
    frame = Frame("", capture / "train" / "r_1.png", capture / "masks" / "train" / "r_1.png", np.eye(4)[:3])
    save_mask(frame, np.zeros((SIZE, SIZE), bool), "visual hull")  # as nerfro.mask does for a camera that looks away
    printed = preprocess("smoothing=0")
    assert "15 of 30 images have no mask (r_0.png, r_2.png, r_4.png and 12 more)" in printed
    assert "views that do not show the object: train/r_1" in printed
    assert len(json.loads((capture / "overlaps.json").read_text())["views"]) == 14
    assert abs(radii(capture).mean() - RADIUS) < 0.05


@pytest.mark.slow
def test_disagreeing_masks_name_the_number_that_may_be_wrong(preprocess: Callable[..., str], capture: Path) -> None:
    def cut(mask: np.ndarray) -> np.ndarray:  # something stands in front of the object's side
        mask[:, int(np.quantile(np.flatnonzero(mask.any(0)), 0.7)) :] = 0
        return mask

    _change_masks(capture, cut, 1)
    # The hull alone: the fit finds most of the side again.
    printed = preprocess("smoothing=0")
    assert "overlap below 0.9" in printed
    suggested = re.search(r"wrong_masks=(\d)", printed)
    assert suggested is not None
    before = json.loads((capture / "overlaps.json").read_text())["views"]
    again = preprocess(f"wrong_masks={suggested[1]}", "smoothing=0", "overwrite=true")
    assert "wrong_masks=" not in again
    after = json.loads((capture / "overlaps.json").read_text())["views"]
    whole = [f"train/r_{view}" for view in range(1, NUM_VIEWS)]
    assert np.mean([after[name] for name in whole]) > np.mean([before[name] for name in whole]) + 0.01
