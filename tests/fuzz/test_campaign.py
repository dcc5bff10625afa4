"""Options, JSON, pictures, masks, meshes, arrays, caches and run folders, drawn at random (see `world.py`)."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tests.fuzz.world import World

_number = itertools.count()

WEIRD_NUMBERS = ["0", "-1", "1", "2", "3", "7", "0.5", "1.5", "-0.5", "1e-30", "1e-5", "1e5", "1e30", "1e308",
                 "1e400", "nan", "inf", "-inf", "1000000000000", "4294967296", "9" * 40, "9" * 400]  # fmt: skip
WEIRD_VALUES = [*WEIRD_NUMBERS, "null", "true", "false", "''", "x", "[]", "[1]", "[nan]", "[1,2,3]", "{}", "{a: 1}",
                "~", "/", "..", "/dev/null", "/etc/passwd", "a b", "a\\nb", "${seed}", "${nope}",
                "'${oc.env:HOME}'", "é", "'" + "a" * 300 + "'", "embedded:", "embedded:torus"]  # fmt: skip
# What starts processes, listens, or has nothing to do with numbers.
_LEFT_ALONE = ("trainer.devices", "trainer.num_nodes", "trainer.strategy", "trainer.accelerator", "trainer.max_time",
               "trainer.profiler", "compile", "logger", "name")  # fmt: skip
GROUPS = ["field=nerf", "field=mip_nerf", "boundary=constant", "boundary=skybox", "boundary=near_field",
          "sampler/points=stratified", "sampler/points=hierarchical", "sampler/path=straight", "sampler/path=eikonal",
          "medium=voxel_grid", "medium=ball", "medium=vacuum", "camera=given", "data=opencv", "data=llff",
          "data=colmap", "data=nerfstudio", "data=idr", "data=refref", "model=mip_nerf",
          "+experiment=mipnerf", "+experiment=nerf", "+experiment=ablation_noH", "+scene=glass",
          "+loss/distortion=distortion"]  # fmt: skip
WEIRD_JSON: list[Any] = [None, True, False, 0, -1, 1, 0.5, 1e39, 1e308, 1e-300, float("nan"), float("inf"), 10**400, "",
                         "x", "..", "/etc/passwd", "a" * 5000, "\0", [], {}, [1], [[1, 2], [3]], {"a": 1}]  # fmt: skip


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, tiny_scene: Path, tiny_default_run: list[str]) -> Iterator[World]:
    world = World(tmp_path_factory.mktemp("world"), tiny_scene, tiny_default_run)
    yield world
    print(f"\n{world.tries} commands, {world.trained} of them trained or evaluated to the end")


@pytest.fixture(scope="module")
def keys(world: World) -> list[str]:
    """Every setting of a run."""
    from omegaconf import OmegaConf

    from nerfro.training.settings import Role, settings

    config = OmegaConf.load(world.root / "run" / "config.yaml")
    return [key for key in settings(config, frozenset(Role)) if not key.startswith(_LEFT_ALONE)]


def fresh(world: World, name: str) -> Path:
    """A folder that is not there."""
    return world.root / f"{name}_{next(_number)}"


def copy_of(world: World, name: str) -> Path:
    """A copy of `data` or `run` to damage."""
    shutil.copytree(world.root / name, folder := fresh(world, name))
    return folder


def damaged(draw: st.DataObject, content: bytes) -> bytes:
    """Some bytes of a file lost, changed, or added."""
    place = draw.draw(st.integers(0, max(len(content) - 1, 0)))
    some = draw.draw(st.binary(max_size=8))
    how = draw.draw(st.sampled_from(["cut", "change", "insert", "all", "twice"]))
    return {
        "cut": content[:place],
        "change": content[:place] + some + content[place + len(some) :],
        "insert": content[:place] + some + content[place:],
        "all": some,
        "twice": content + content[place:],
    }[how]


def rays() -> dict[str, np.ndarray]:
    """Through the middle of the ball."""
    return {"origins": np.tile([[0, 0, 4.0]], (9, 1)), "directions": np.tile([[0, 0, -1.0]], (9, 1))}


def clean(*folders: Path) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


@given(draw=st.data())
def test_options_of_training(world: World, keys: list[str], draw: st.DataObject) -> None:
    groups = draw.draw(st.lists(st.sampled_from(GROUPS), max_size=1))
    options = []
    for _ in range(draw.draw(st.integers(1, 2))):
        key = draw.draw(st.sampled_from(keys))
        if draw.draw(st.integers(0, 9)) == 0:  # misspelt
            place = draw.draw(st.integers(0, len(key) - 1))
            key = draw.draw(st.sampled_from(["", "+", "++", "~"])) + key[:place] + key[place + 1 :]
        options.append(f"{key}={draw.draw(st.sampled_from(WEIRD_VALUES))}")
    run = fresh(world, "out")
    options = [*world.train_options(world.root / "data"), *groups, *options, f"hydra.run.dir={run}"]
    assert world.trouble("train", *options, own=(run,)) is None, options
    clean(run)


@given(draw=st.data())
def test_options_of_other_commands(world: World, draw: st.DataObject) -> None:
    data, run, out = world.root / "data", world.root / "run", fresh(world, "out")
    np.savez(world.root / "rays.npz", **rays())
    commands = {
        "trace": ["medium.mesh", "medium.ior", "medium.resolution", "medium.box_max", "medium.shell_voxels",
                  "medium.inner_iors", "sampler.path.max_events",
                  "sampler.path.interface", "near", "far", "rays", "plot", "out", "overwrite"],
        "evaluate": ["split", "root", "chunk_size", "subdivision.side", "subdivision.divergence", "masks", "alpha",
                     "protocol", "device", "lpips_backbone", "predictions", "references", "overwrite"],
        "summary": ["metrics", "region", "methods", "scenes", "views", "report"],
        "preprocess": ["split", "mesh", "resolution", "box_min", "wrong_masks", "keep", "smoothing", "medium.ior",
                       "data.near", "data.downscale"],
        "mask": ["outlines", "overwrite", "data.near", "data.downscale"],
        "calibrate": ["images", "target", "board", "family", "columns", "rows", "size", "marker", "dictionary", "model",
                      "lens", "intrinsics", "distortion", "test_every", "write_board"],
        "synthesize": ["scene", "resolution", "spp", "views.train", "photographs", "noise", "sky_height", "variant"],
    }  # fmt: skip
    always = {
        "trace": [f"medium.mesh={data}/mesh.ply", f"rays={world.root}/rays.npz", f"out={out}/o.npz",
                  "medium.resolution=32"],
        "evaluate": [f"checkpoint={run}/checkpoints/last.ckpt", f"out={out}", "device=cpu"],
        "summary": [f"runs=[{run}]", f"out={out}"],
        "preprocess": [f"data.root={data}", f"out={out}", "resolution=16"],
        "mask": [f"data.root={data}"],
        "calibrate": [f"images={data}/train", f"out={out}"],
        "synthesize": [f"out={world.root}/data"],  # holds something else, so that nothing is rendered
    }  # fmt: skip
    name = draw.draw(st.sampled_from(sorted(commands)))
    drawn = draw.draw(st.lists(st.sampled_from(commands[name]), min_size=1, max_size=2, unique=True))
    options = [f"{key}={draw.draw(st.sampled_from(WEIRD_VALUES))}" for key in drawn]
    if name == "trace":
        out.mkdir()
    assert world.trouble(name, *always[name], *options, own=(out,)) is None, (name, options)
    clean(out)


def places(node: object, path: tuple = ()) -> Iterator[tuple]:
    """Where the values of a JSON document are."""
    yield path
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, child in children:
        yield from places(child, (*path, key))


@given(draw=st.data())
def test_json(world: World, draw: st.DataObject) -> None:
    data, run = copy_of(world, "data"), fresh(world, "out")
    file = data / f"transforms_{draw.draw(st.sampled_from(['train', 'test']))}.json"
    document = json.loads(file.read_text())
    document["frames"][0]["mask_path"] = "train/r_0.png"
    how = draw.draw(st.sampled_from(["value", "value", "value", "missing", "key", "bytes", "deep"]))
    path = draw.draw(st.sampled_from([place for place in places(document) if place]))
    node = document
    for key in path[:-1]:
        node = node[key]
    if how == "value":
        node[path[-1]] = draw.draw(st.sampled_from(WEIRD_JSON))
    elif how == "missing":
        del node[path[-1]]
    elif how == "key":
        document[draw.draw(st.sampled_from(["w", "h", "fl_x", "aabb"]))] = draw.draw(st.sampled_from(WEIRD_JSON))
    text = json.dumps(document)
    file.write_bytes(damaged(draw, text.encode()) if how == "bytes" else text.encode())
    if how == "deep":
        file.write_text("[" * 5000)
    assert world.trouble("train", *world.train_options(data), f"hydra.run.dir={run}", own=(run,)) is None
    clean(data, run)


@given(draw=st.data())
def test_pictures_and_masks(world: World, draw: st.DataObject) -> None:
    data, run = copy_of(world, "data"), fresh(world, "out")
    file = data / "train" / "r_1.png"
    if draw.draw(st.booleans()):
        file = data / "masks" / "train" / "r_1.png"
        file.parent.mkdir(parents=True)
        if draw.draw(st.booleans()):
            for name in ("r_0", "r_1", "r_2"):
                Image.new("L", (16, 16), 255).save(file.with_name(f"{name}.png"))
    mode = draw.draw(st.sampled_from(["1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "I", "I;16", "F"]))
    size = draw.draw(st.sampled_from([(16, 16), (16, 16), (16, 15), (1, 1), (0, 0), (3000, 1)]))
    picture = Image.new(mode, size)
    exif = Image.Exif()
    exif[274] = draw.draw(st.sampled_from([0, 1, 6, 9, 77]))
    form = draw.draw(st.sampled_from(["PNG", "JPEG", "TIFF", "BMP", "GIF", "WEBP"]))
    try:
        picture.save(file, form, **({"exif": exif} if form in ("PNG", "JPEG") else {}))
    except Exception:  # Pillow cannot write such a picture
        file.write_bytes(draw.draw(st.binary(max_size=64)))
    if draw.draw(st.booleans()):
        file.write_bytes(damaged(draw, file.read_bytes()))
    assert world.trouble("train", *world.train_options(data), f"hydra.run.dir={run}", own=(run,)) is None
    clean(data, run)


MESHES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "ball": lambda: trimesh.creation.icosphere(1, 0.6),
    "box": lambda: trimesh.creation.box((0.5, 0.5, 0.5)),
    "flat": lambda: trimesh.creation.box((0.5, 0.5, 1e-9)),
    "point": lambda: trimesh.creation.icosphere(1, 1e-30),
    "huge": lambda: trimesh.creation.icosphere(1, 1e9),
    "twice": lambda: trimesh.util.concatenate([trimesh.creation.icosphere(1, 0.6)] * 2),
    "crossing": lambda: trimesh.util.concatenate(
        [trimesh.creation.icosphere(1, 0.4), trimesh.creation.box((0.6, 0.2, 0.2)).apply_translation((0.3, 0.1, 0))]
    ),
    "far": lambda: trimesh.creation.icosphere(1, 0.6).apply_translation((1e7, 0, 0)),
    "none": lambda: trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), int)),
}


def save_mesh(draw: st.DataObject, file: Path) -> None:
    mesh = MESHES[draw.draw(st.sampled_from(sorted(MESHES)))]()
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if len(vertices) and draw.draw(st.booleans()):
        value = draw.draw(st.sampled_from([np.nan, np.inf, 1e30, 0.0, -1e-30]))
        vertices[draw.draw(st.integers(0, len(vertices) - 1)), draw.draw(st.integers(0, 2))] = value
    if len(faces) and draw.draw(st.booleans()):
        face = draw.draw(st.integers(0, len(faces) - 1))
        change = draw.draw(st.sampled_from(["index", "collapse", "reverse", "lose", "copy"]))
        if change == "index":
            faces[face, 0] = draw.draw(st.sampled_from([0, len(vertices), 2**31 - 1]))
        elif change == "collapse":
            faces[face] = faces[face, 0]
        elif change == "reverse":
            faces[face] = faces[face, ::-1]
        elif change == "lose":
            faces = np.delete(faces, face, 0)
        else:
            faces = np.concatenate([faces, faces[face : face + 1]])
    rows = [f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    if draw.draw(st.booleans()):
        rows += [f"3 {a} {b} {c}" for a, b, c in faces]
        numbers = "property float x\nproperty float y\nproperty float z"
        head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n{numbers}\nelement face {len(faces)}\n"
        file.write_text("\n".join([f"{head}property list uchar int vertex_indices\nend_header", *rows, ""]))
    else:
        file = file.with_suffix(".obj")
        file.write_text("\n".join([f"v {row}" for row in rows] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]))
    if draw.draw(st.integers(0, 3)) == 0:
        file.write_bytes(damaged(draw, file.read_bytes()))
    if file.suffix == ".obj":
        file.rename(file.with_suffix(".ply")) if draw.draw(st.integers(0, 9)) == 0 else None


@given(draw=st.data())
def test_meshes(world: World, draw: st.DataObject) -> None:
    out = fresh(world, "out")
    out.mkdir()
    save_mesh(draw, out / "mesh.ply")
    file = next(path for path in out.iterdir() if path.suffix in (".ply", ".obj"))
    np.savez(out / "rays.npz", **rays())
    medium = draw.draw(st.sampled_from(["sdf_grid", "voxel_grid"]))
    sampler = "eikonal" if medium == "voxel_grid" else draw.draw(st.sampled_from(["snell", "eikonal"]))
    options = [f"medium={medium}", f"medium.mesh={file}", f"sampler/path={sampler}", "medium.resolution=24"]
    if draw.draw(st.booleans()):
        options.append("medium.accept_open_mesh=true")
    if medium == "sdf_grid" and sampler == "snell" and draw.draw(st.booleans()):
        options.append("sampler.path.interface=mesh")
    found = world.trouble("trace", *options, f"rays={out}/rays.npz", f"out={out}/o.npz", own=(out,))
    assert found is None, options
    clean(out)


@given(draw=st.data())
def test_rays(world: World, draw: st.DataObject) -> None:
    out = fresh(world, "out")
    out.mkdir()
    arrays = rays()
    name = draw.draw(st.sampled_from(sorted(arrays)))
    how = draw.draw(st.sampled_from(["value", "type", "shape", "missing", "extra", "bytes"]))
    if how == "value":
        arrays[name][3, 1] = draw.draw(st.sampled_from([np.nan, np.inf, 1e39, 1e300, -1e7, 1e5, 1e-300, 0.5]))
    elif how == "type":
        kinds = ["?", "i1", "u8", "f2", "f4", "f8", "g", "c8", "c16", "U3", "S3", "M8[s]", "m8[s]", "V4", ">f8"]
        with np.errstate(all="ignore"):
            try:
                arrays[name] = arrays[name].astype(draw.draw(st.sampled_from(kinds)))
            except (TypeError, ValueError):
                arrays[name] = np.zeros((9, 3), "V4")
    elif how == "shape":
        arrays[name] = np.ones(draw.draw(st.sampled_from([(), (0,), (3,), (0, 3), (9, 2), (8, 3), (9, 3, 1), (3, 9)])))
    elif how == "missing":
        del arrays[name]
    elif how == "extra":
        arrays["near"] = np.ones(3)
    np.savez(out / "rays.npz", **arrays)
    if how == "bytes":
        (out / "rays.npz").write_bytes(damaged(draw, (out / "rays.npz").read_bytes()))
    options = [f"medium.mesh={world.root}/data/mesh.ply", "medium.resolution=24", f"rays={out}/rays.npz"]
    assert world.trouble("trace", *options, f"out={out}/o.npz", own=(out,)) is None
    clean(out)


@given(draw=st.data())
def test_caches(world: World, draw: st.DataObject) -> None:
    out = fresh(world, "out")
    out.mkdir()
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.savez(out / "rays.npz", origins=-2 * directions + generator.normal(size=(50, 3)) / 9, directions=directions)
    options = [f"medium.mesh={world.root}/data/mesh.ply", "medium.resolution=20", f"rays={out}/rays.npz"]
    assert world.command("trace", *options, f"out={out}/right.npz").code == 0
    (cached,) = (path for path in (world.root / "cache").glob("distance_*.npz") if "20, 20, 20" in _shapes(path))
    content = cached.read_bytes()
    if draw.draw(st.booleans()):
        cached.write_bytes(damaged(draw, content))
    else:
        with np.load(cached) as file:
            arrays = dict(file)
        arrays["distance"] = draw.draw(
            st.sampled_from([arrays["distance"] * np.nan, -arrays["distance"], np.zeros(3), np.array("x")])
        )
        np.savez(cached, **arrays)
    assert world.trouble("trace", *options, f"out={out}/again.npz", own=(out,)) is None
    with np.load(out / "right.npz") as right, np.load(out / "again.npz") as again:
        for name in right.files:
            np.testing.assert_array_equal(right[name], again[name])
    cached.write_bytes(content)
    clean(out)


def _shapes(path: Path) -> str:
    try:
        with np.load(path) as file:
            return str(file["distance"].shape)
    except Exception:
        return ""


@given(draw=st.data())
def test_run_folders(world: World, draw: st.DataObject) -> None:
    run, out = copy_of(world, "run"), fresh(world, "out")
    files = sorted(path for path in run.rglob("*") if path.is_file())
    file = draw.draw(st.sampled_from([run / "config.yaml", run / "run.json", run / "metrics.json", *files]))
    how = draw.draw(st.sampled_from(["bytes", "gone", "folder", "value"]))
    if how == "bytes":
        file.write_bytes(damaged(draw, file.read_bytes()))
    elif how == "value" and file.suffix == ".json":
        document = json.loads(file.read_text())
        path = draw.draw(st.sampled_from([place for place in places(document) if place]))
        node = document
        for key in path[:-1]:
            node = node[key]
        node[path[-1]] = draw.draw(st.sampled_from(WEIRD_JSON))
        file.write_text(json.dumps(document))
    else:
        file.unlink()
        if how == "folder":
            file.mkdir()
    options = world.train_options(world.root / "data")
    checkpoint = run / "checkpoints" / "last.ckpt"
    commands: dict[str, tuple[list[str], tuple[Path, ...]]] = {
        "summary": ([f"runs=[{run}]", f"out={out}", "report=true"], (out,)),
        "evaluate": ([f"checkpoint={checkpoint}", f"out={out}", "device=cpu"], (out,)),
        "train": ([*options, f"hydra.run.dir={run}"], ()),
    }
    name = draw.draw(st.sampled_from(sorted(commands)))
    arguments, own = commands[name]
    if name == "train" and draw.draw(st.booleans()):
        last = draw.draw(st.booleans())
        arguments = [*options, "trainer.max_steps=2", f"hydra.run.dir={run if last else out}"]
        arguments.append("ckpt_path=last" if last else f"ckpt_path={checkpoint}")
        own = (run if last else out,)
    if name == "summary" and draw.draw(st.booleans()):
        cell = b'{"state": "failed", "reason": "x", "data": "y", "settings": {}}'
        (run / "cell.json").write_bytes(damaged(draw, cell))
    assert world.trouble(name, *arguments, own=own) is None, (name, how, file.name)
    clean(run, out)
