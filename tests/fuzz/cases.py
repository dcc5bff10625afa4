"""Random broken inputs of every type.

A case draws one input, gives it to a command or to the reader that the command calls, and returns what does not hold
(see `world.py`); None if everything holds.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
import operator
import os
import random
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
import trimesh
from omegaconf import OmegaConf
from PIL import Image

from nerfro.data.formats import refref
from nerfro.data.image_files import read_levels, read_mask
from nerfro.evaluation.results import EvaluationResult, RunMetrics, ViewScores, read_metrics_json, write_metrics_json
from nerfro.files import lat_long
from nerfro.files.reading import load_array, read_foreign_config
from nerfro.geometry.mesh import load_mesh
from nerfro.masks.mask_files import read_outlines
from nerfro.rendering.scene_file import with_scene
from nerfro.samplers.paths.traced_file import read_rays
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint, scene_of
from nerfro.training.settings import Role, settings
from tests.data.formats import FORMATS
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
GROUPS = ["field=nerf", "field=mip_nerf", "background=constant", "background=skybox", "background=near_field",
          "sampler/points=stratified", "sampler/points=hierarchical", "sampler/path=straight", "sampler/path=eikonal",
          "medium=voxel_grid", "medium=vacuum", "camera=given", "data=opencv", "data=llff",
          "data=colmap", "data=nerfstudio", "data=idr", "data=refref", "model=mip_nerf",
          "+experiment=mipnerf", "+experiment=nerf", "+experiment=ablation_noH", "+scene=glass",
          "+loss/distortion=distortion"]  # fmt: skip
WEIRD_JSON: list[Any] = [None, True, False, 0, -1, 1, 0.5, 1e39, 1e308, 1e-300, float("nan"), float("inf"), 10**400, "",
                         "x", "..", "/etc/passwd", "a" * 5000, "\0", [], {}, [1], [[1, 2], [3]], {"a": 1}]  # fmt: skip


def settings_of_a_run(world: World) -> list[str]:
    """Every setting of a run."""
    config = OmegaConf.load(world.root / "run" / "config.yaml")
    return [key for key in settings(config, frozenset(Role)) if not key.startswith(_LEFT_ALONE)]


def fresh(world: World, name: str) -> Path:
    """A folder that is not there."""
    return world.root / f"{name}_{next(_number)}"


def copy_of(world: World, name: str) -> Path:
    """A copy of `data` or `run` to damage."""
    shutil.copytree(world.root / name, folder := fresh(world, name))
    return folder


def damaged(draw: random.Random, content: bytes) -> bytes:
    """Some bytes of a file lost, changed, or added."""
    place = draw.randint(0, max(len(content) - 1, 0))
    some = draw.randbytes(draw.randint(0, 8))
    mutation = draw.choice(["cut", "change", "insert", "all", "twice"])
    return {
        "cut": content[:place],
        "change": content[:place] + some + content[place + len(some) :],
        "insert": content[:place] + some + content[place:],
        "all": some,
        "twice": content + content[place:],
    }[mutation]


def rays_through_ball() -> dict[str, np.ndarray]:
    """Through the middle of the ball."""
    return {"origins": np.tile([[0, 0, 4.0]], (9, 1)), "directions": np.tile([[0, 0, -1.0]], (9, 1))}


def options_of_training(world: World, draw: random.Random) -> str | None:
    groups = draw.sample(GROUPS, draw.randint(0, 1))
    options = []
    for _ in range(draw.randint(1, 2)):
        key = draw.choice(settings_of_a_run(world))
        if draw.randint(0, 9) == 0:  # misspelt
            place = draw.randint(0, len(key) - 1)
            key = draw.choice(["", "+", "++", "~"]) + key[:place] + key[place + 1 :]
        options.append(f"{key}={draw.choice(WEIRD_VALUES)}")
    run = fresh(world, "out")
    options = [*world.train_options(world.root / "data"), *groups, *options, f"hydra.run.dir={run}"]
    return world.trouble("train", *options, own=(run,))


def options_of_other_commands(world: World, draw: random.Random) -> str | None:
    data, run, out = world.root / "data", world.root / "run", fresh(world, "out")
    np.savez(world.root / "rays.npz", **rays_through_ball())
    commands = {
        "trace": ["medium.mesh", "medium.ior", "medium.resolution", "medium.box_max", "medium.shell_voxels",
                  "medium.bodies", "sampler.path.max_events",
                  "sampler.path.interface", "near", "far", "rays", "plot", "out", "overwrite"],
        "evaluate": ["split", "root", "chunk_size", "subdivision.side", "subdivision.divergence", "masks", "alpha",
                     "device", "predictions", "references", "overwrite"],
        "summary": ["metrics", "region", "methods", "scenes", "views", "report"],
        "preprocess": ["mesh", "resolution", "box_min", "wrong_masks", "keep", "smoothing", "medium.ior",
                       "data.near", "data.downscale", "data.mask_labels"],
        "mask": ["outlines", "overwrite", "data.near", "data.downscale"],
        "calibrate": ["images", "target", "board", "columns", "rows", "size", "lens", "pairs", "threads",
                      "reconstruction", "mask_labels", "test_every", "write_board"],
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
    name = draw.choice(sorted(commands))
    drawn = draw.sample(commands[name], draw.randint(1, 2))
    options = [f"{key}={draw.choice(WEIRD_VALUES)}" for key in drawn]
    if name == "trace":
        out.mkdir()
    return world.trouble(name, *always[name], *options, own=(out,))


def places(node: object, path: tuple = ()) -> Iterator[tuple]:
    """Where the values of a JSON document are."""
    yield path
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, child in children:
        yield from places(child, (*path, key))


def pictures_and_masks(world: World, draw: random.Random) -> str | None:
    data, run = copy_of(world, "data"), fresh(world, "out")
    file = data / "train" / "r_1.png"
    if draw.random() < 0.5:
        file = data / "masks" / "train" / "r_1.png"
        file.parent.mkdir(parents=True)
        if draw.random() < 0.5:
            for name in ("r_0", "r_1", "r_2"):
                Image.new("L", (16, 16), 255).save(file.with_name(f"{name}.png"))
    mode = draw.choice(["1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "I", "I;16", "F"])
    size = draw.choice([(16, 16), (16, 16), (16, 15), (1, 1), (0, 0), (3000, 1)])
    picture = Image.new(mode, size)
    exif = Image.Exif()
    exif[274] = draw.choice([0, 1, 6, 9, 77])
    form = draw.choice(["PNG", "JPEG", "TIFF", "BMP", "GIF", "WEBP"])
    try:
        picture.save(file, form, **({"exif": exif} if form in ("PNG", "JPEG") else {}))
    except Exception:  # Pillow cannot write such a picture
        file.write_bytes(draw.randbytes(draw.randint(0, 64)))
    if draw.random() < 0.5:
        file.write_bytes(damaged(draw, file.read_bytes()))
    return world.trouble("train", *world.train_options(data), f"hydra.run.dir={run}", own=(run,))


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


def save_mesh(draw: random.Random, file: Path) -> None:
    mesh = MESHES[draw.choice(sorted(MESHES))]()
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if len(vertices) and draw.random() < 0.5:
        value = draw.choice([np.nan, np.inf, 1e30, 0.0, -1e-30])
        vertices[draw.randint(0, len(vertices) - 1), draw.randint(0, 2)] = value
    if len(faces) and draw.random() < 0.5:
        face = draw.randint(0, len(faces) - 1)
        change = draw.choice(["index", "collapse", "reverse", "lose", "copy"])
        if change == "index":
            faces[face, 0] = draw.choice([0, len(vertices), 2**31 - 1])
        elif change == "collapse":
            faces[face] = faces[face, 0]
        elif change == "reverse":
            faces[face] = faces[face, ::-1]
        elif change == "lose":
            faces = np.delete(faces, face, 0)
        else:
            faces = np.concatenate([faces, faces[face : face + 1]])
    trimesh.Trimesh(vertices, faces, process=False).export(file)
    if draw.randint(0, 3) == 0:
        file.write_bytes(damaged(draw, file.read_bytes()))


def meshes(world: World, draw: random.Random) -> str | None:
    out = fresh(world, "out")
    out.mkdir()
    save_mesh(draw, file := out / draw.choice(["mesh.ply", "mesh.obj"]))
    np.savez(out / "rays.npz", **rays_through_ball())
    medium = draw.choice(["sdf_grid", "voxel_grid"])
    sampler = "eikonal" if medium == "voxel_grid" else draw.choice(["snell", "eikonal"])
    options = [f"medium={medium}", f"medium.mesh={file}", f"sampler/path={sampler}", "medium.resolution=24"]
    if draw.random() < 0.5:
        options.append("medium.accept_open_mesh=true")
    if medium == "sdf_grid" and sampler == "snell" and draw.random() < 0.5:
        options.append("sampler.path.interface=mesh")
    return world.trouble("trace", *options, f"rays={out}/rays.npz", f"out={out}/o.npz", own=(out,))


def run_folders(world: World, draw: random.Random) -> str | None:
    run, out = copy_of(world, "run"), fresh(world, "out")
    files = sorted(path for path in run.rglob("*") if path.is_file())
    file = draw.choice([run / "config.yaml", run / "run.json", run / "metrics.json", *files])
    damage(draw, file)
    options = world.train_options(world.root / "data")
    checkpoint = run / "checkpoints" / "last.ckpt"
    commands: dict[str, tuple[list[str], tuple[Path, ...]]] = {
        "summary": ([f"runs=[{run}]", f"out={out}", "report=true"], (out,)),
        "evaluate": ([f"checkpoint={checkpoint}", f"out={out}", "device=cpu"], (out,)),
        "train": ([*options, f"hydra.run.dir={run}"], ()),
    }
    name = draw.choice(sorted(commands))
    arguments, own = commands[name]
    if name == "train" and draw.random() < 0.5:
        last = draw.random() < 0.5
        arguments = [*options, "trainer.max_steps=2", f"hydra.run.dir={run if last else out}"]
        arguments.append("ckpt_path=last" if last else f"ckpt_path={checkpoint}")
        own = (run if last else out,)
    if name == "summary" and draw.random() < 0.5:
        cell = b'{"state": "failed", "reason": "x", "data": "y", "settings": {}}'
        (run / "cell.json").write_bytes(damaged(draw, cell))
    return world.trouble(name, *arguments, own=own)


WEIRD_TEXTS = [*WEIRD_NUMBERS, "true", "x", "-", "1e999", "\u0663", "", "1,5", "0x10", "1 2", "&a [*a]", "*b", "{",
               "null"]  # fmt: skip


def data_formats(world: World, draw: random.Random) -> str | None:
    """Damage one file of a data set in any format, and read all its splits."""
    name = draw.choice([*FORMATS, "colmap_text"])
    form = FORMATS[name.removesuffix("_text")]
    if not (template := world.root / "formats" / name).is_dir():
        arguments = {"form": "text"} if name == "colmap_text" else {}
        template.mkdir(parents=True)
        form.write(template, masks=True, **arguments)
    shutil.copytree(template, root := fresh(world, "data"), symlinks=True)
    file = draw.choice(sorted(path for path in root.rglob("*") if path.is_file()))
    damage(draw, file)

    def read() -> None:
        for split in ("train", "test"):
            views = form.source(str(root), **form.options).load(split).checked()
            cameras = views.cameras
            numbers = [cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.camera_to_world]
            assert all(tensor.isfinite().all() for tensor in numbers), "cameras that are not finite"
            assert 0 <= cameras.near < cameras.far < math.inf, "bounds that are not finite"
            assert all(image.isfinite().all() for image in views.images), "colours that are not finite"

    with mock.patch.object(refref, "_VIEWS_PER_SPLIT", 2):
        return world.trouble_of_reader(read, f"{name}: {file.relative_to(root)}")


def damage(draw: random.Random, file: Path) -> None:
    """Damage a value or bytes of a file, or replace the file by something else."""
    mutation = draw.choice(["value"] * 6 + ["bytes", "bytes", "bytes", "empty", "gone", "folder", "pipe"])
    if mutation == "value" and file.suffix == ".json":
        document = json.loads(file.read_text())
        *parents, last = draw.choice([place for place in places(document) if place])
        node = functools.reduce(operator.getitem, parents, document)
        node[last] = draw.choice(WEIRD_JSON)
        if draw.random() < 0.2:
            del node[last]
        file.write_text(json.dumps(document))
    elif mutation == "value" and file.suffix in (".txt", ".yaml", ".obj", ".off", ".csv"):
        text = file.read_text()
        found = draw.choice(list(re.finditer(r"-?\d+\.?\d*(e-?\d+)?|true|false|null", text)))
        file.write_text(text[: found.start()] + draw.choice(WEIRD_TEXTS) + text[found.end() :])
    elif mutation in ("value", "bytes"):
        file.write_bytes(damaged(draw, file.read_bytes()))
    else:
        file.unlink()
        {"empty": file.touch, "gone": lambda: None, "folder": file.mkdir, "pipe": lambda: os.mkfifo(file)}[mutation]()


def _save_metrics(file: Path) -> None:
    scores = {"full": {"psnr": 20.0, "ssim": 0.9}}
    views = tuple(ViewScores(f"test_{i:03d}", scores["full"], scores) for i in range(2))
    write_metrics_json(file, RunMetrics(EvaluationResult(views), 3, 1.5, 20.0))


def _save_picture(file: Path) -> None:
    levels = np.random.default_rng(0).integers(0, 256, (9, 16, 3), dtype=np.uint8)
    Image.fromarray(levels).save(file)


def _save_ball(file: Path) -> None:
    trimesh.creation.icosphere(1, 0.6).export(file)


OUTLINES = {"a": [1, 2, 30, 40], "b": [[1, 2], [3, 4], [5, 1]]}
SCENE = {
    "data": {"type": "blender", "root": ".."},
    "medium": {"resolution": 32, "box_min": [-1.0, -1.0, -1.0]},
    "bodies": {
        "glass": {"mesh": "mesh.ply", "ior": 1.5},
        "water": {"surface": {"name": "distances", "file": "water.npz"}, "material": "water"},
    },
    "vessel": {"wall": 0.1},
    "surroundings": "near",
    "photograph": [64, 48],
    "provenance": {"command": "x", "versions": {"nerfro": "1"}, "standard_error": [0.1], "doubts": ["y"]},
}
CONFIG = {"name": "x", "seed": 1, "data": {"root": "r", "near": 2.0}, "batches": {"size": 8}, "loss": {"a": [1, 2]}}
# How a file of each kind is written and read.
FILES: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    **{f"ball.{form}": (_save_ball, load_mesh) for form in ("ply", "obj", "stl", "glb", "off")},
    **{f"picture.{form}": (_save_picture, read_levels) for form in ("png", "jpg", "webp", "tif", "bmp")},
    **{f"mask.{form}": (_save_picture, read_mask) for form in ("png", "jpg")},
    **{f"sky.{form}": (lambda file: lat_long.save_lat_long(file, torch.rand(8, 16, 3)), lat_long.load_lat_long)
       for form in ("hdr", "exr")},
    "rays.npz": (lambda file: np.savez(file, **rays_through_ball()), read_rays),
    "array.npy": (lambda file: np.save(file, np.ones((2, 3))), load_array),
    "outlines.json": (lambda file: file.write_text(json.dumps(OUTLINES)), lambda file: read_outlines(str(file))),
    "metrics.json": (_save_metrics, read_metrics_json),
    "scene.json": (lambda file: file.write_text(json.dumps(SCENE)),
                   lambda file: with_scene([f"scene={file}"], ["data", "medium"])),
    "config.yaml": (lambda file: file.write_text(OmegaConf.to_yaml(CONFIG)), read_foreign_config),
}  # fmt: skip


def single_files(world: World, draw: random.Random) -> str | None:
    """Damage a file of one kind, and read it."""
    name = draw.choice(list(FILES))
    write, read = FILES[name]
    write(file := world.root / name)
    damage(draw, file)
    return world.trouble_of_reader(lambda: read(file), name)


WEIRD_OBJECTS: list[Any] = [None, True, -5, 0, 1.5, 1e308, math.nan, math.inf, "x", "", [], {}, [1], {"a": 1}, (),
                            torch.tensor(math.nan), torch.zeros(0), torch.ones(2, 3)]  # fmt: skip


def checkpoints(world: World, draw: random.Random) -> str | None:
    """Damage a value anywhere in a checkpoint, or bytes of the file, and restore the scene."""
    checkpoint = torch.load(world.root / "run" / LAST_CHECKPOINT, weights_only=True)
    file = fresh(world, "checkpoint")
    mutation = draw.choice(["value", "value", "missing", "number", "setting", "bytes"])
    path = draw.choice([place for place in places(checkpoint) if place])
    node: Any = checkpoint
    for key in path[:-1]:
        node = node[key]
    if mutation == "missing":
        del node[path[-1]]
    elif mutation == "number" and isinstance(node[path[-1]], torch.Tensor):
        node[path[-1]].view(-1)[:1] = draw.choice([math.nan, math.inf, 1e30])
    elif mutation == "setting":
        config = OmegaConf.create(checkpoint["nerfro_config"])
        setting, value = draw.choice(settings_of_a_run(world)), draw.choice(WEIRD_JSON)
        OmegaConf.update(config, setting, value, merge=False, force_add=True)
        checkpoint["nerfro_config"] = OmegaConf.to_yaml(config)
    else:
        node[path[-1]] = draw.choice(WEIRD_OBJECTS)
    torch.save(checkpoint, file)
    if mutation == "bytes":
        file.write_bytes(damaged(draw, file.read_bytes()))

    def read() -> None:
        trained = scene_of(*load_checkpoint(file), torch.device("cpu"))
        rendered = trained.render(trained.cameras("test").select([0]))
        assert rendered.rgb.isfinite().all(), "a rendering that is not finite"

    return world.trouble_of_reader(read, f"{mutation} of {'.'.join(map(str, path))}")


KINDS: dict[str, Callable[[World, random.Random], str | None]] = {
    case.__name__: case
    for case in (options_of_training, options_of_other_commands, pictures_and_masks, meshes, run_folders,
                 data_formats, single_files, checkpoints)
}  # fmt: skip
