"""The scene file: moved folders, precedence of the command line, and one-line errors."""

import json
from pathlib import Path
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from nerfro.core.provenance import AlgorithmSettings
from nerfro.media.body_settings import BodySettings
from nerfro.rendering.scene_file import Provenance, SceneFile, read_scene_file, with_scene
from tests.conftest import refused

NODES = ["data", "medium", "sampler"]
DATA = {"type": "opencv", "root": ".."}


def write(path: Path, **content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def settings(*arguments: str) -> dict[str, Any]:
    """Settings of a command line with a scene file, as Hydra reads them; the last of several values holds."""
    parsed = OverridesParser.create().parse_overrides(with_scene(arguments, NODES))
    return {override.get_key_element(): override.value() for override in parsed}


def test_scene_file_is_valid_after_moving_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "old capture" / "surface").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    scene = SceneFile(
        data={"type": "opencv", "root": "old capture", "near": 0.1},
        medium={"type": "object", "box_min": [-1.0, -1.0, -2.0]},
        bodies={"object": BodySettings(mesh="old capture/surface/mesh.ply", ior=1.5)},
        surroundings="near",
        photograph=[640, 480],
        provenance=Provenance(standard_error=[0.002, None]),
    )
    scene.save(Path("old capture/surface/scene.json"))
    (tmp_path / "old capture").rename("new")
    moved = read_scene_file(Path("new/surface/scene.json"))
    assert moved.provenance.versions["nerfro"]
    assert moved.provenance.algorithms == [*AlgorithmSettings.used.values()]
    moved.provenance = scene.provenance
    assert json.dumps(moved, default=vars) == json.dumps(scene, default=vars).replace("old capture", "new")
    link = tmp_path / "elsewhere" / "link"
    link.parent.mkdir()
    link.symlink_to(tmp_path / "new" / "surface")
    assert read_scene_file(link / "scene.json").data["root"] == str((tmp_path / "new").resolve())


def test_command_line_has_precedence_over_the_scene_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bodies, vessel = {"object": {"mesh": "mesh.ply", "ior": 1.4}}, {"wall": 0.1, "ior": 1.52}
    content = {"data": DATA | {"downscale": 2.0}, "bodies": bodies, "vessel": vessel}
    file = write(tmp_path / "surface" / "scene.json", **content, medium={"resolution": 64})
    expected = {"data": "opencv", "data.root": str(tmp_path), "data.downscale": 2, "medium.resolution": 64,
                "medium.mesh": str(tmp_path / "surface" / "mesh.ply"), "medium.ior": 1.4}  # fmt: skip
    assert settings(f"scene={file}") == expected
    assert settings("medium.ior=1.6", f"scene={file}", "data=opencv") == expected | {"medium.ior": 1.6}
    of_other_data = {name: value for name, value in expected.items() if name != "data.downscale"}
    assert settings(f"scene={file}", "data=blender") == of_other_data | {"data": "blender"}
    as_vessel = {"medium": "vessel", "medium.wall": 0.1, "medium.ior": 1.52}
    assert settings(f"scene={file}", "medium=vessel") == expected | as_vessel
    assert with_scene(["seed=1"], NODES) == ["seed=1"]
    assert with_scene(["--cfg", "job", "seed=1", f"scene={file}"], ["data"])[:3] == ["--cfg", "job", "data=opencv"]
    assert not [text for text in with_scene([f"scene={file}"], ["medium"]) if text.startswith("data")]
    assert capsys.readouterr().out == ""
    write(file, **content, provenance={"doubts": ["the minimum is shallow"]})
    assert settings(f"scene={file}")["medium.ior"] == 1.4
    assert "do not determine the index (the minimum is shallow); set medium.ior=" in capsys.readouterr().out
    assert settings(f"scene={file}", "medium.ior=1.6")["medium.ior"] == 1.6
    assert capsys.readouterr().out == ""


def test_bodies_with_materials_keep_their_names(tmp_path: Path) -> None:
    bodies: dict[str, Any] = {"glass": {"mesh": "a b.ply", "ior": 1.5}, "water": {"mesh": "c.ply", "ior": 1.33}}
    file = write(tmp_path / "scene.json", data=DATA, bodies=bodies)
    places = {name: body | {"mesh": str(tmp_path / body["mesh"])} for name, body in bodies.items()}
    assert settings(f"scene={file}")["medium.bodies"] == places
    bodies["water"] = {"mesh": "c.ply", "material": "water", "learn": ["absorption"]}
    bodies["glass"]["learn"] = []  # nothing, whatever `medium.learn_ior` is
    offset = {"name": "offset", "surface": {"name": "mesh", "file": "d.ply"}, "distance": -0.5}
    bodies["air"] = {"surface": offset, "ior": 1.0}
    file = write(tmp_path / "scene.json", data=DATA, bodies=bodies)
    assert settings(f"scene={file}")["medium.bodies"] == {
        "glass": {"mesh": str(tmp_path / "a b.ply"), "ior": 1.5, "learn": []},
        "water": {"mesh": str(tmp_path / "c.ply"), "material": "water", "learn": ["absorption"]},
        "air": {"surface": offset | {"surface": {"name": "mesh", "file": str(tmp_path / "d.ply")}}, "ior": 1.0},
    }


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "is not a scene file"),
        ({}, "lacks the text data.type"),
        ({"data": {"type": "opencv"}}, "lacks the text data.root"),
        ({"data": DATA, "body": {}}, "body is not a setting; did you mean bodies?"),
        ({"data": DATA, "bodies": {"object": {"iro": 1.5}}}, "bodies.object.iro is not a setting; did you mean ior?"),
        ({"data": DATA, "bodies": {"object": {"ior": "x"}}}, "bodies.object.ior='x' is not allowed; take a number"),
        ({"data": DATA, "surroundings": "close"}, "surroundings='close' is not allowed; choose 'near', 'far'"),
        ({"data": DATA, "photograph": [0, 4]}, "photograph=[0, 4] is not allowed"),
        ({"data": DATA | {"far seed=3": 1}}, "data has the key 'far seed=3'"),
        ({"data": DATA | {"_target_": "os.system"}}, "data has the key '_target_'"),
        ({"data": DATA | {"near": "${oc.env:HOME}"}}, "contains an interpolation"),
    ],
)
def test_mistakes_give_a_one_line_error(content: Any, message: str, tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text(json.dumps(content))
    assert message in refused("scene", with_scene, [f"scene={tmp_path}/scene.json"], NODES)
