"""Plugins from plugins/, from other folders, and from installed packages; and the command that lists them."""

import contextlib
import csv
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from omegaconf import DictConfig
from PIL import Image
from torch import nn
from torch.nn import functional

from nerfro.backgrounds.base import Background
from nerfro.cli.options import Described
from nerfro.core import types
from nerfro.core.paths import PLUGINS_DIR
from nerfro.data.base import DataSource, Views
from nerfro.data.formats.transforms import BlenderData
from nerfro.evaluation.image_metrics import ImageMetric
from nerfro.fields.base import Field
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.space import Space
from nerfro.losses.base import Loss
from nerfro.media.base import Medium
from nerfro.media.surfaces import Surface
from nerfro.models.refractive import RefractiveModel
from nerfro.registry.registration import KINDS, discover, find, plugins, register
from nerfro.samplers.base import PathSampler, PointSampler
from nerfro.samplers.paths.snell import Snell
from nerfro.testing import (
    ContractError,
    check,
    check_export,
    example_ball,
    example_path,
    example_rays,
    example_samples,
)
from nerfro.training.phases.base import Phase, TrainingRun
from nerfro.viewing.exports import EXPORTS, Export, find_export
from nerfro.viewing.trained_scene import TrainedScene
from tests.conftest import Finished, Runner, refused
from tests.processes import printed_by, python

discover()

BACKGROUND = '''
"""A background."""
import torch
from nerfro.backgrounds.base import Background
from nerfro.registry.registration import register


@register("background", "{name}")
class OneGrey(Background):
    """The same grey in every direction."""

    def __init__(self, grey: float = 0.5) -> None:
        super().__init__()
        self.grey = grey

    def forward(self, exits):
        return torch.full_like(exits.directions, self.grey)
'''


pytestmark = pytest.mark.usefixtures("restored_registry")


@pytest.fixture
def write_plugin(tmp_path: Path) -> Callable[[str, str], Path]:
    def write(name: str, source: str) -> Path:
        folder = tmp_path / "plugins_of_mine"
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.py").write_text(source)
        return folder

    return write


@pytest.mark.parametrize(
    ("source", "cause"),
    [
        ("import no_such_package", "ModuleNotFoundError: No module named 'no_such_package'"),
        ("def f(:", "SyntaxError: "),
        ("1 / 0", "ZeroDivisionError: division by zero"),
    ],
)
def test_failing_plugin_is_named_with_the_cause(
    source: str, cause: str, write_plugin: Callable[[str, str], Path]
) -> None:
    folder = write_plugin("broken", source)
    refused(f"^plugin {folder / 'broken.py'} cannot be imported: {cause}", discover, folder)


def tuples(_: nn.Module, samples: types.Samples) -> object:
    return samples.s, samples.positions


def too_few(_: nn.Module, samples: types.Samples) -> types.FieldValues:
    return types.FieldValues(samples.s[:1], samples.positions[:1])


@pytest.mark.parametrize(
    ("base", "forward", "message"),
    [
        (
            Field,
            tuples,
            r"Broken\.forward in .*test_plugins\.py returned a tuple; return FieldValues with density \[P, N\]",
        ),
        (Field, too_few, r"returned a FieldValues of other shapes; return FieldValues with density"),
        (
            Background,
            lambda _, exits: exits.directions[..., :1],
            r"returned a Tensor of shape .*; return radiance \[\.\.\., 3\] in",
        ),
        (
            PointSampler,
            lambda _, path, previous, draws=None: None,
            "returned a NoneType; return Samples on all polylines",
        ),
        (PathSampler, lambda _, rays, medium: example_path(4), "returned a Path of other shapes; return a Path with"),
    ],
)
def test_result_that_breaks_the_contract_names_the_file_and_what_was_expected(
    base: type, forward: Callable[..., object], message: str
) -> None:
    inputs = {Field: example_samples(), Background: example_path().exits(), PointSampler: example_path(),
              PathSampler: example_rays()}  # fmt: skip
    others = {PointSampler: [None], PathSampler: [example_ball()]}
    made = type("Broken", (base,), {"forward": forward, "__module__": __name__, "num_levels": 1})()
    refused(message, made, inputs[base], *others.get(base, []))


METRIC = """
from nerfro.evaluation.image_metrics import ImageMetric
from nerfro.registry.registration import register

@register("metric", "worst")
class Worst(ImageMetric):
    '''Largest error.'''
    better = "lower"
    def forward(self, prediction, target, inside=None):
        return ((prediction - target).abs() if inside is None else (prediction - target).abs()[inside]).max()
"""


@pytest.mark.parametrize(
    ("part", "replacement", "advice"),
    [
        ('better = "lower"', "", 'add better = "higher" or better = "lower"'),
        (", inside=None", "", "write forward(self, prediction, target, inside=None)"),
        ("Worst(ImageMetric)", "Worst", "derive it from nerfro.evaluation.image_metrics.ImageMetric"),
    ],
)
def test_metric_that_cannot_be_scored_is_refused_with_its_file(
    part: str, replacement: str, advice: str, write_plugin: Callable[[str, str], Path]
) -> None:
    folder = write_plugin("worst_metric", METRIC.replace(part, replacement))
    assert advice in refused(f"^plugin {folder / 'worst_metric.py'}: metric=worst: class Worst ", discover, folder)


def test_metric_without_a_title_has_its_name(write_plugin: Callable[[str, str], Path]) -> None:
    discover(write_plugin("worst_metric", METRIC))
    check(find("metric", "worst"))
    assert find("metric", "worst").cls.title == "worst"


def ones(medium: Medium, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.ones_like(positions[..., 0]), torch.zeros_like(positions)


CUBE = np.array([[-1.0] * 3, [1.0] * 3])


def ball(change: Callable[[np.ndarray], np.ndarray], bounds: np.ndarray = CUBE) -> dict[str, object]:
    """Return the members of a surface whose distances are those of a unit ball, changed."""
    return {"bounds": bounds, "distances": lambda _, grid: change(np.linalg.norm(grid.points, axis=-1) - 1)}


def sphere(scale: float = 1.0, reverse: bool = False, hole: bool = False) -> dict[str, object]:
    """Return the members of the surface of a unit ball with triangles, which may be wrong."""
    mesh = trimesh.creation.icosphere(2, scale)
    faces = np.asarray(mesh.faces)[int(hole) :, :: -1 if reverse else 1]
    return {**ball(lambda d: d), "mesh": TriangleMesh(np.asarray(mesh.vertices), faces)}


def grid_field(contract: bool = True, scale: bool = True) -> dict[str, object]:
    """Return the members of a field on a grid over the space, with or without contraction and scale."""

    def init(self: Any, space: Space) -> None:
        Field.__init__(self)
        self.space, self.grid = space, nn.Parameter(torch.rand(1, 4, 8, 8, 8))

    def forward(self: Any, samples: types.Samples) -> types.FieldValues:
        low, high = self.space.box
        places = self.space.contract(samples.positions) if contract else samples.positions
        unit = (2 * (places - low) / (high - low) - 1).reshape(1, 1, 1, -1, 3)
        values = functional.grid_sample(self.grid, unit, align_corners=True).reshape(4, *samples.s.shape).sigmoid()
        density = values[0] * (self.space.scale(samples.positions) if scale else 1)
        return types.FieldValues(density, values[1:].movedim(0, -1))

    return {"__init__": init, "forward": forward, "bounds": None, "needs_box": True}


def cut_at_far(_: PathSampler, rays: types.Rays, medium: Medium) -> types.Path:
    path = Snell()(rays, medium)
    s = path.s.minimum(rays.far[:, None])
    return replace(path, s=s, positions=path.at(s)[0])


def metric(of_errors: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> dict[str, object]:
    """Return the members of a metric, a function of the errors of all pixels and of the mask."""

    def forward(_: ImageMetric, prediction: torch.Tensor, target: torch.Tensor, inside: Any = None) -> torch.Tensor:
        errors = (prediction - target).abs().mean(-1)
        return of_errors(errors, torch.ones_like(errors, dtype=torch.bool) if inside is None else inside)

    return {"forward": forward, "better": "lower"}


def outside_of_edges(sampler: PointSampler, path: types.Path, previous: object, draws: object = None) -> types.Samples:
    near, length = path.near[:, None], (path.far - path.near)[:, None]
    s, edges = near + length * torch.linspace(0.4, 0.6, 4), near + length * torch.linspace(0.0, 0.2, 5)
    return types.Samples.along(path, s, edges)


def loss(forward: Callable[..., object]) -> dict[str, object]:
    return {"forward": lambda _, renderings, batch, scene: forward(renderings[-1], batch)}


def phase(step: Callable[[nn.Parameter], object] = lambda _: True, **members: object) -> dict[str, object]:
    """Return the members of a phase with one step, which may change a parameter."""

    def first(run: TrainingRun) -> nn.Parameter:
        return next(iter(run.renderer.parameters_by_name().values()))

    return {"steps_before": lambda _, step: 1, "step": lambda _, run, number, state: step(first(run)), **members}


def noise(parameter: nn.Parameter) -> bool:
    parameter.data.add_(torch.rand_like(parameter))
    return True


def overflow(parameter: nn.Parameter) -> bool:
    parameter.data.fill_(torch.inf)
    return True


def brightened(model: RefractiveModel, path: types.Path, batch: types.Batch | None = None) -> list[types.Rendering]:
    return [replace(r, radiance=r.radiance + 0.1) for r in RefractiveModel.render_path(model, path, batch)]


def lens(factor: float) -> dict[str, object]:
    """Members of a medium with n = 2 - |x|^2 in the unit ball, and grad n = `factor` x, which -2 makes correct."""

    def forward(medium: Medium, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        squared = positions.square().sum(-1)
        return (2 - squared).clamp(min=1), torch.where(squared[..., None] < 1, factor * positions, 0.0)

    return {"forward": forward, "box": torch.tensor(CUBE, dtype=torch.float32)}


def ramp(slope: float, start: float) -> dict[str, object]:
    """Members of a medium with n = start + slope x in a cube, so n has a step at its faces."""

    def forward(medium: Medium, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        inside = (positions.abs() <= 1).all(-1)
        gradient = torch.where(inside[..., None], torch.tensor([slope, 0.0, 0.0]), 0.0)
        return torch.where(inside, start + slope * positions[..., 0], 1.0), gradient

    return {"forward": forward, "box": torch.tensor(CUBE, dtype=torch.float32)}


@pytest.mark.parametrize("members", [lens(-2.0), ramp(0.1, 1.4), ramp(1e-6, 1.4)], ids=["lens", "step", "constant"])
def test_medium_of_varying_index_keeps_its_contract(members: dict[str, object]) -> None:
    register("medium", "broken")(type("Lens", (Medium,), {"__doc__": "Lens.", "__module__": __name__, **members}))
    check(find("medium", "broken"))


@pytest.mark.parametrize(
    ("kind", "base", "members", "contract"),
    [
        ("medium", Medium, {"forward": ones}, r"a medium has a buffer `box` \[2, 3\]"),
        ("medium", Medium, {}, "Broken lacks forward"),
        ("medium", Medium, lens(1.0), "forward returns grad n per world unit"),
        ("medium", Medium, lens(-4.0), "forward returns grad n per world unit"),
        ("surface", Surface, {"distances": None}, "a surface has `bounds`"),
        ("surface", Surface, {"distances": None, "bounds": CUBE[0]}, r"a surface has `bounds` \[2, 3\]"),
        ("surface", Surface, ball(lambda d: d, CUBE[::-1]), "the lower corner of `bounds` is first"),
        ("surface", Surface, ball(lambda d: d[1:]), "one number for each vertex"),
        ("surface", Surface, ball(lambda d: d * np.nan), "distances are finite"),
        ("surface", Surface, ball(np.abs), "distances are negative inside"),
        ("surface", Surface, ball(lambda d: d, 0.5 * CUBE), "positive outside of `bounds`"),
        ("surface", Surface, ball(lambda d: 2 * d), "change by at most one per unit of length"),
        ("surface", Surface, ball(lambda d: 0.5 * d), "exact within `grid.band` voxels"),
        ("surface", Surface, sphere(scale=1.3), "the triangles of `mesh` lie where distances are zero"),
        ("surface", Surface, sphere(hole=True), "`mesh` is closed"),
        ("surface", Surface, sphere(reverse=True), "faces of `mesh` are counter-clockwise from outside"),
        ("field", Field, grid_field(contract=False), "cover all of space, as functions of space.contract"),
        ("field", Field, grid_field(scale=False), r"density / space\.scale and radiance have limits far away"),
        ("metric", ImageMetric, metric(lambda e, _: e.mean()), "outside of the mask `inside` do not count"),
        (
            "metric",
            ImageMetric,
            metric(lambda e, i: e.diff(dim=0)[i[1:]].abs().mean()),
            "an image of min_size = 1 pixels",
        ),
        ("sampler/path", PathSampler, {"forward": cut_at_far}, "bent paths end outside of medium.box"),
        ("loss", Loss, {"forward": lambda *_: None}, "forward returned None, not Tensor"),
        ("loss", Loss, loss(lambda r, _: r.opacity), r"a loss is a scalar, and forward returned shape \[24\]"),
        ("loss", Loss, loss(lambda r, b: (r.radiance - b.rgb).mean()), "pixels with two rays raised RuntimeError"),
        ("loss", Loss, loss(lambda r, _: (r.weights.sum(-1) - r.opacity).mean()), "rays that split, .* RuntimeError"),
        ("loss", Loss, loss(lambda r, _: r.opacity.log().mean()), "a loss is finite for empty pixels"),
        ("loss", Loss, loss(lambda r, _: r.transmittance.log().mean()), "a loss is finite for opaque pixels"),
        ("loss", Loss, loss(lambda r, _: r.opacity.sqrt().mean()), "a loss has finite gradients for empty pixels"),
        ("loss", Loss, loss(lambda r, _: r.opacity.mean() * torch.rand(())), "random numbers only from batch.draws"),
        ("loss", Loss, loss(lambda r, _: r.opacity.mean().detach()), "depends on the renderings or on the scene"),
        ("phase", Phase, phase(steps_before=lambda _, step: step / 2), "steps_before returns integers from 0 on"),
        ("phase", Phase, phase(steps_before=lambda _, step: step - 1), "steps_before returns integers from 0 on"),
        ("phase", Phase, phase(begin=lambda _, run: None), "begin returns a dictionary, not None"),
        ("phase", Phase, phase(begin=lambda _, run: {"a": Path("b")}), "which a checkpoint can contain"),
        ("phase", Phase, phase(lambda _: None), "step returns True, or False to end the phase, not None"),
        ("phase", Phase, phase(overflow), "parameters are finite after a step"),
        ("phase", Phase, phase(noise), "random numbers of a step depend on its number"),
        ("phase", Phase, phase(lambda parameter: parameter.typo), "phase=broken raised AttributeError"),
        (
            "sampler/path",
            PathSampler,
            {"forward": lambda *_: None},
            "returned a NoneType; return a Path with a polyline for each ray",
        ),
        (
            "phase",
            Phase,
            phase(steps_before=lambda _, step: step % 5),
            "steps_before is cumulative: it returned 4 before step 4 and 0 before step 5",
        ),
        ("sampler/points", PointSampler, {"forward": outside_of_edges, "num_levels": 1}, "lie between their edges"),
        ("data", DataSource, {"load": None, "splits": ["train"]}, "has the attribute `root`"),
        ("model", RefractiveModel, {"render_path": brightened}, "set empty_shows_background = False"),
    ],
)
def test_check_names_the_violated_contract(kind: str, base: type, members: dict[str, object], contract: str) -> None:
    register(kind, "broken")(type("Broken", (base,), {"__doc__": "Broken.", "__module__": __name__, **members}))
    with pytest.raises(ContractError, match=contract):
        check(find(kind, "broken"))


@pytest.mark.parametrize(
    ("kind", "base", "members"),
    [
        ("surface", Surface, sphere()),
        ("field", Field, grid_field()),
        ("metric", ImageMetric, metric(lambda e, i: e[i].mean())),
        ("sampler/path", PathSampler, {"forward": cut_at_far, "ends_at_far": True}),
    ],
)
def test_check_accepts_what_keeps_the_contract(kind: str, base: type, members: dict[str, object]) -> None:
    register(kind, "kept")(type("Kept", (base,), {"__doc__": "Kept.", "__module__": __name__, **members}))
    check(find(kind, "kept"))


def test_views_refuse_a_list_of_images() -> None:
    # Without the constructor, whose annotations are checked in tests alone.
    views = SimpleNamespace(images=[torch.zeros(16, 16, 3)], masks=None, usable=None)
    refused(r"Views\.images is a list; give one tensor of all views", Views.__post_init__, views)


def test_plugin_with_a_taken_name_names_both_modules_and_its_file(write_plugin: Callable[[str, str], Path]) -> None:
    folder = write_plugin("clash", BACKGROUND.format(name="constant"))
    message = refused("background=constant is registered twice", discover, folder)
    for word in (str(folder / "clash.py"), "nerfro.backgrounds.base", "nerfro_plugins.clash"):
        assert word in message


def test_two_files_of_one_name_are_refused(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "same.py").write_text(BACKGROUND.format(name=f"grey_{folder}"))
    discover(tmp_path / "one")
    refused(r"two plugin files are called same: .*one.* and .*two", discover, tmp_path / "two")


def test_missing_plugin_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_PLUGINS", str(tmp_path / "nowhere"))
    refused(r"plugin folder .*nowhere does not exist; correct NERFRO_PLUGINS", discover)


@pytest.mark.parametrize(("variable", "found"), [(None, True), ("", False)])
def test_plugins_of_the_current_directory_are_registered_unless_the_environment_replaces_them(
    variable: str | None, found: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "grey_here.py").write_text(BACKGROUND.format(name="grey_here"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NERFRO_PLUGINS", raising=False)
    if variable is not None:
        monkeypatch.setenv("NERFRO_PLUGINS", variable)
    discover()
    assert ("grey_here" in {plugin.name for plugin in plugins("background")}) is found


# Overrides that use each template.
TEMPLATES = {
    "example_surface": [
        "medium=object",
        "sampler/path=snell",
        "medium.resolution=32",
        "bodies={ring: {surface: {name: torus}, ior: 1.5}}",
    ],
    "example_background": ["background=gradient_sky"],
    "example_camera": ["camera=shifted"],
    "example_data": ["data=numpy_views"],
    "example_field": ["field=blobs"],
    "example_loss": ["+loss.opacity_entropy.weight=0.1"],
    "example_medium": ["medium=gradient_rod", "sampler/path=eikonal"],
    "example_model": ["model=haze"],
    "example_path_sampler": ["sampler/path=mirror_floor"],
    "example_phase": ["+phase.extra_steps.every=1"],
    "example_sampler": ["sampler/points=logarithmic", "sampler.points.num_samples=8"],
    "opt_in/example_callback": ["+callbacks=gradient_norm"],
    "opt_in/example_export": [],
    "opt_in/example_metric": ["optimized_metric=mean_absolute_error"],
}


@pytest.fixture
def train_template(
    train_here: Runner, tiny_run: list[str], tiny_scene: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Runner:  # fmt: skip
    """Train twenty steps with some overrides, and without the tiny settings of components that they replace."""
    monkeypatch.setenv("NERFRO_PLUGINS", str(PLUGINS_DIR / "opt_in"))
    discover()
    (tmp_path / "views").mkdir()
    shutil.copy(tiny_scene / "mesh.ply", tmp_path / "views")
    for split in ("train", "test"):
        views = BlenderData(str(tiny_scene)).load(split)
        images = np.stack([np.uint8(np.round(255 * image.numpy())) for image in views.images])
        np.savez(
            tmp_path / "views" / f"{split}.npz",
            images=images, poses=views.cameras.camera_to_world.numpy(), focal=views.cameras.fx[0].item(),
        )  # fmt: skip

    def train(overrides: list[str], code: int = 0) -> Finished:
        replaced = tuple(f"{override.partition('=')[0].replace('/', '.')}." for override in overrides)
        kept = [option for option in tiny_run if not option.startswith(replaced)]
        options = [
            "trainer.max_steps=20",
            "evaluation.every=0",
            "logger=tensorboard",
            f"hydra.run.dir={tmp_path / 'run'}",
        ]
        root = [f"data.root={tmp_path / 'views'}"] if "data=numpy_views" in overrides else []
        return train_here(*kept, *overrides, *root, *options, code=code)

    return train


@pytest.mark.parametrize(
    "template", sorted(str(p.relative_to(PLUGINS_DIR)) for p in PLUGINS_DIR.glob("**/example_*.py"))
)
def test_template_trains(template: str, train_template: Runner) -> None:
    finished = train_template(TEMPLATES[template.removesuffix(".py")])
    assert "20 steps in" in finished.out
    assert "initial values" not in finished.out, "all parameters learn"


def writer(*names: str, text: str | None = "a file") -> Callable[..., str | None]:
    """Return a function that writes files beside the given one, and returns a description."""

    def write(scene: TrainedScene, out: Path, config: DictConfig) -> str | None:
        for name in names:
            out.with_name(name).touch()
        return text

    return write


@pytest.mark.parametrize(
    ("export", "contract"),
    [
        (Export((), writer()), r"suffixes=\(\) are not a tuple of endings"),
        (Export((".CSV",), writer()), "in lower case with a dot"),
        (Export((".csv",), writer()), "write writes the file `out`"),
        (Export((".csv",), lambda scene, out, config: 1 / 0), "what=broken raised ZeroDivisionError"),  # type: ignore[arg-type, return-value]
        (Export((".csv",), writer("scene.csv", text="")), "write returns a description"),
        (Export((".csv",), writer("scene.csv", "scene.mtl")), r"companions lacks the endings of scene\.mtl"),
        (Export((".csv",), writer("scene.csv", "scene.mtl"), (".mtl",)), None),
    ],
)
def test_check_names_the_violated_contract_of_an_export(
    export: Export, contract: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(EXPORTS, "broken", export)
    with contextlib.nullcontext() if contract is None else pytest.raises(ContractError, match=contract):
        check_export("broken")


def test_exports_keep_their_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_PLUGINS", str(PLUGINS_DIR / "opt_in"))
    for name in ("camera_centres", "sky"):
        check_export(name)


def test_export_without_a_writer_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXPORTS, "broken", __name__)  # type: ignore[arg-type]
    refused(r"EXPORTS\['broken'\] of a plugin is .*; make it an Export", find_export, "broken", Path("out.csv"))


def test_loss_that_is_no_scalar_is_refused(train_template: Runner) -> None:
    members = {"__doc__": "Not a scalar.", **loss(lambda rendering, _: rendering.opacity)}
    register("loss", "opacities")(type("Opacities", (Loss,), members))
    assert "loss=opacities returned shape [" in train_template(["+loss.opacities.weight=1"], code=1).error


def test_metric_of_a_plugin_is_in_tables_files_log_and_report(
    train_template: Runner, tmp_path: Path, run_here: Runner
) -> None:
    trained, run = train_template([]), tmp_path / "run"
    mean = json.loads((run / "metrics.json").read_text())["test"]["mean_absolute_error"]
    references = np.load(tmp_path / "views" / "test.npz")["images"]
    predictions = np.stack([np.asarray(Image.open(file)) for file in sorted((run / "images").glob("*.png"))])
    assert mean == pytest.approx(np.abs(references / 255 - predictions / 255).mean(), abs=1e-6)
    assert "MAE ↓" in trained.out
    assert f"{mean:.4f}" in trained.out
    with (run / "csv" / "metrics.csv").open() as file:
        logged = [row["test/mean_absolute_error"] for row in csv.DictReader(file)]
    assert float(logged[-1]) == pytest.approx(mean)
    run_here("summary", f"runs={run}", f"out={tmp_path / 'out'}", "report=true")
    assert "MAE ↓" in (tmp_path / "out" / "report.html").read_text()


# The list.


def test_list_shows_every_plugin_with_its_fields_defaults_and_summary(run_here: Runner) -> None:
    words = " ".join(run_here("plugins").out.split())
    for plugin in plugins():
        assert f"{plugin.kind}={plugin.name}" in words
        assert " ".join(plugin.summary.split()) in words
        for name, kind, _ in plugin.fields():
            assert f" {name}=" in words
            assert kind.replace("`", "") in words
    assert {plugin.kind for plugin in plugins()} == set(KINDS)


@pytest.mark.parametrize(
    ("argument", "message"),
    [("colour", "'colour' is not a plugin type; choose one of model"), ("field=x", "no field is called 'x'; known: ")],
)
def test_list_of_unknown_plugins_is_refused(argument: str, message: str, run_here: Runner) -> None:
    assert message in run_here("plugins", argument, code=1).error


def test_list_shows_a_single_metric(run_here: Runner) -> None:
    Described("", {}, {}).require_known(["metric=psnr", "surface=ball"])  # before the imports
    assert run_here("plugins", "metric=psnr").out.startswith("metric=psnr  Peak signal-to-noise ratio")


# Installed packages.

PYPROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "nerfro-grey"
version = "1.0"
[project.entry-points."nerfro.plugins"]
grey = "nerfro_grey.background"
[tool.hatch.build.targets.wheel]
packages = ["nerfro_grey"]
"""

# The commands' own mains, in one process: to begin one takes most of the time.
USE_IT = """
import sys
import nerfro.plugins
from nerfro.train import main
from nerfro.registry.registration import find
from nerfro.testing import check
sys.argv = ["nerfro.plugins", "background=installed_grey"]
nerfro.plugins.main()
check(find("background", "installed_grey"))
print("kept its contract")
sys.argv = "nerfro.train background=installed_grey background.grey=0.25 --cfg job -p background".split()
main()
"""


@pytest.mark.slow
def test_installed_package_is_found_listed_and_checked(tmp_path: Path) -> None:
    project, site = tmp_path / "project", tmp_path / "site"
    (project / "nerfro_grey").mkdir(parents=True)
    (project / "pyproject.toml").write_text(PYPROJECT)
    (project / "nerfro_grey" / "__init__.py").touch()
    (project / "nerfro_grey" / "background.py").write_text(BACKGROUND.format(name="installed_grey"))
    install(project, site)
    found = os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])
    used = printed_by("-c", USE_IT, folder=tmp_path, PYTHONPATH=found)
    listed, kept, job = used.partition("kept its contract\n")
    assert "The same grey in every direction." in listed
    assert kept
    assert "grey: 0.25" in job
    # One that cannot be imported stops the run and is named.
    (site / "nerfro_grey" / "background.py").write_text("import no_such_package\n")
    broken = python("-m", "nerfro.plugins", folder=tmp_path, PYTHONPATH=found)
    assert broken.returncode == 1
    assert broken.stderr.strip() == (
        "nerfro: error: plugin 'grey' of an installed package (nerfro_grey.background) cannot be imported: "
        "ModuleNotFoundError: No module named 'no_such_package'"
    )


def install(project: Path, site: Path) -> None:
    """`pip install` a project offline into a folder; skips where hatchling is not installed."""
    pytest.importorskip("hatchling")
    if shutil.which("pip") is None and python("-m", "pip", "--version").returncode:
        pytest.skip("pip is not installed")
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", str(site)]
    printed_by("-m", "pip", "install", *options, str(project))
