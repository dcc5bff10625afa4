"""Contracts of plugins, one function for each type of plugin."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import pickle
import tempfile
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch

from nerfro.backgrounds.base import Background
from nerfro.camera.base import CameraModel
from nerfro.core.compositing import composite
from nerfro.core.draws import Draws
from nerfro.core.types import Exits, FieldValues, Path, Rendering, Samples
from nerfro.data.base import DataSource
from nerfro.evaluation.image_metrics import ImageMetric, ViewMaps
from nerfro.fields.base import Field
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.orientation import inward_faces
from nerfro.geometry.space import Contracted, inside_box
from nerfro.losses.base import Loss
from nerfro.media.base import Medium
from nerfro.media.distance_grid import DistanceGrid
from nerfro.media.surfaces import Grid, Surface
from nerfro.registry.registration import Plugin, build
from nerfro.rendering import Renderer
from nerfro.samplers.base import PathSampler, PointSampler, straight_path
from nerfro.samplers.points.stratified import point_samples
from nerfro.testing.examples import (
    NUM_RAYS,
    ExampleData,
    LuneburgLens,
    example_ball,
    example_batch,
    example_components,
    example_contracted_space,
    example_draws,
    example_path,
    example_rays,
    example_rendering,
    example_run,
    example_samples,
    example_space,
)
from nerfro.training.phases.base import Phase
from nerfro.viewing.exports import ExportConfig, export_of
from nerfro.viewing.trained_scene import TrainedScene


class ContractError(AssertionError):
    """A plugin breaks the contract of its type."""


def check(plugin: Plugin, fields: Mapping[str, object] | None = None) -> None:
    """Check a registered plugin against the contract of its type.

    Args:
        plugin: plugin to check.
        fields: values of required fields.

    Raises:
        ContractError: the plugin breaks a contract.
        NerfroError: a required field has no value, or a value is not allowed.
    """
    _require(bool(plugin.summary), "the class has no docstring, which `python -m nerfro.plugins` shows")
    base, check_contract = _CONTRACTS[plugin.kind]
    made = plugin.cls if isinstance(plugin.cls, type) else typing.get_type_hints(plugin.cls)["return"]
    _require(issubclass(made, base), f"a {plugin.kind} derives from {base.__module__}.{base.__name__}")
    missing = sorted(getattr(made, "__abstractmethods__", ()))
    _require(not missing, f"{plugin.cls.__name__} lacks {', '.join(missing)}")
    node = {"_target_": plugin.target, **(fields or {})}
    built = build(node, components=example_components(), space=example_space())
    with _named(f"{plugin.kind}={plugin.name}"):
        check_contract(built)
        if plugin.kind == "field" and built.needs_box and "space" in plugin.parts:
            space = example_contracted_space()
            built = build(node, components=example_components(), space=space)
            _check_field(built)
            _check_far_field(built, space)


@contextlib.contextmanager
def _named(plugin: str) -> Iterator[None]:
    """Report any error of a plugin's author as a broken contract of the plugin."""
    try:
        yield
    except ContractError:
        raise
    except Exception as error:
        first_line = str(error).strip().partition("\n")[0]
        raise ContractError(f"contract broken: {plugin} raised {type(error).__name__}: {first_line}") from error


def check_export(name: str) -> None:
    """Check an export: write a file of a small scene of dense content, with default options.

    Args:
        name: name of the export, as in `what=NAME`.

    Raises:
        ContractError: the export breaks a contract.
        NerfroError: there is no such export.
    """
    export = export_of(name)
    endings: Sequence[str] = export.suffixes
    _require(
        not isinstance(endings, str)
        and (export.is_folder or (len(endings) > 0 and all(e == e.lower() and e[:1] == "." for e in endings))),
        f"suffixes={endings!r} are not a tuple of endings in lower case with a dot, such as ('.csv',), nor ('',)",
    )
    # Dense content has a surface, which some exports need.
    scene = TrainedScene(example_run(initial_depth=400.0).renderer.eval(), ExampleData())
    with tempfile.TemporaryDirectory() as folder:
        out = FilePath(folder, f"scene{endings[0]}")
        options = ExportConfig(checkpoint="-", what=name, out=str(out))
        with _named(f"what={name}"):
            text = export.write(scene, out, options)
        _require(isinstance(text, str) and text != "", "write returns a description of the file, which is printed")
        _require(
            out.is_dir() if export.is_folder else out.is_file(),
            "write writes the file `out`" if not export.is_folder else "write writes the folder `out`",
        )
        others = {file.name for file in FilePath(folder).iterdir()} - {file.name for file in export.files(out)}
        _require(not others, f"companions lacks the endings of {', '.join(sorted(others))}")


def _check_medium(medium: Medium) -> None:
    box = getattr(medium, "box", None)
    _require(box is not None and box.shape == (2, 3), "a medium has a buffer `box` [2, 3], its lower and upper corner")
    low, high = medium.box
    points = low + torch.rand(200, 3) * (high - low)
    ior, gradient = medium(points)
    _require(ior.shape == (200,) and gradient.shape == (200, 3), "forward returns n [...] and grad n [..., 3]")
    _require(bool((ior > 0).all()) and bool(gradient.isfinite().all()), "n is positive and grad n finite")
    ior, gradient = medium(high + (high - low) * (1 + torch.rand(50, 3)))
    _require(bool((ior == 1).all()) and bool((gradient == 0).all()), "outside the box n = 1 and grad n = 0")
    _check_gradient_of_index(medium)


@torch.no_grad()
def _check_gradient_of_index(medium: Medium) -> None:
    """Compare grad n with central differences by the median over random points, so that few are close to a step of n.

    Points where n changes less than its rounding errors do not count.
    """
    low, high = medium.box
    points = low + torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)).to(low) * (high - low)
    gradient = medium(points)[1]
    step = 5e-4 * (high - low).norm()
    shifts = step * torch.eye(3).to(low)
    differences = torch.stack([medium(points + each)[0] - medium(points - each)[0] for each in shifts], -1) / (2 * step)
    squared = gradient.square().sum(-1)
    steep = squared.sqrt() * step > 1e-5
    ratios = ((gradient * differences).sum(-1) / squared)[steep]
    _require(not steep.any() or 0.5 < float(ratios.median()) < 1.5, "forward returns grad n per world unit")


def _check_surface(surface: Surface) -> None:
    bounds = np.asarray(getattr(surface, "bounds", None))
    _require(bounds.shape == (2, 3), "a surface has `bounds` [2, 3], its lower and upper corner")
    _require(bool((bounds[0] < bounds[1]).all()), "the lower corner of `bounds` is first")
    grid = Grid(bounds + 0.2 * np.ptp(bounds, axis=0) * [[-1], [1]], 24)
    distances = surface.distances(grid)
    _require(distances.shape == (24, 24, 24), "distances returns one number for each vertex of the grid")
    _require(bool(np.isfinite(distances).all()), "distances are finite")
    outside = ((grid.points < bounds[0]) | (grid.points > bounds[1])).any(-1)
    _require(bool((distances < 0).any()), "distances are negative inside")
    _require(bool((distances[outside] > 0).all()), "distances are positive outside of `bounds`")
    spacing = np.ptp(grid.box, axis=0) / (grid.resolution - 1)
    steepest = max(np.abs(np.diff(distances, axis=axis)).max() / spacing[axis] for axis in range(3))
    _require(bool(steepest < 1.01), "distances change by at most one per unit of length")
    near = np.abs(distances) < grid.band * spacing.min()
    slope = np.linalg.norm(np.gradient(distances, *spacing), axis=0)[near]
    _require(not near.any() or bool(np.median(slope) > 0.9), "distances are exact within `grid.band` voxels")
    if surface.mesh is not None:
        _check_triangles(surface.mesh, DistanceGrid(torch.from_numpy(distances), torch.from_numpy(grid.box)))


def _check_triangles(mesh: TriangleMesh, grid: DistanceGrid) -> None:
    points = torch.from_numpy(np.concatenate([mesh.vertices, mesh.triangles.mean(1)]))
    _require(
        bool((grid(points)[0].abs() < grid.spacing.max()).all()), "the triangles of `mesh` lie where distances are zero"
    )
    _require(mesh.is_closed, "`mesh` is closed, and its triangles share vertices")
    _require(not inward_faces(mesh.vertices, mesh.faces).any(), "faces of `mesh` are counter-clockwise from outside")


def _check_camera(camera: CameraModel) -> None:
    camera.begin(example_batch().cameras)
    rays = camera(example_rays(), torch.arange(NUM_RAYS) % 2)
    _require(rays.origins.shape == (NUM_RAYS, 3) and _unit(rays.directions), "forward returns unit rays")


def _check_path_sampler(sampler: PathSampler) -> None:
    rays = example_rays()
    medium: Medium = example_ball()
    path = sampler(rays, medium)
    num_vertices = path.s.shape[1]
    _require(num_vertices >= 2, "a path has two vertices or more")
    _require(bool((path.ray.diff() >= 0).all()), "polylines are in the order of the rays")
    _require(path.positions.shape == (len(path.ray), num_vertices, 3), "positions are [P, S, 3]")
    _require(path.directions.shape == path.positions.shape, "directions are [P, S, 3]")
    share = path.sum_polylines(torch.ones(len(path.ray), 3))
    _require(bool((share < 1 + 1e-4).all()), "the polylines of a ray bring all of its light at most")
    _require(bool((path.s.diff(dim=1) >= 0).all()), "arc length does not decrease")
    _require(torch.allclose(path.near, path.broadcast_to_polylines(rays.near), atol=1e-4), "the path begins at near")
    _require(_unit(path.directions) and _unit(path.exit_directions), "directions have unit length")
    lengths = path.positions.diff(dim=1).norm(dim=-1)
    _require(torch.allclose(lengths, path.s.diff(dim=1), atol=1e-3), "s is the length of the polyline")
    steps = path.directions[:, :-1] * path.s.diff(dim=1)[..., None]
    _require(
        torch.allclose(path.positions[:, :-1] + steps, path.positions[:, 1:], atol=0.05),
        "following a vertex's direction leads to the next vertex",
    )
    if sampler.needs_medium:
        if torch.allclose(path.exit_directions, path.broadcast_to_polylines(rays.directions)):
            medium = LuneburgLens()  # a sampler may need a continuous index
            _require(
                not torch.allclose(sampler(rays, medium).exit_directions, rays.directions),
                "rays bend in a ball or in a Luneburg lens; set needs_medium = False if the sampler ignores the medium",
            )
        path = sampler(replace(rays, far=torch.full_like(rays.far, 4.0)), medium)  # within the medium
        _require(bool(path.refracted.any()), "`Path.refracted` marks paths that bend")
        after = (path.end_positions + 1e-3 * path.exit_directions)[path.refracted]
        _require(
            sampler.ends_at_far or not bool(inside_box(after, *medium.box).any()),
            "bent paths end outside of medium.box, beyond far if necessary",
        )


def _check_point_sampler(sampler: PointSampler) -> None:
    path = example_path()

    def drawn(draws: Draws | None) -> torch.Tensor:
        rendering: Rendering | None = None
        for _ in range(sampler.num_levels):
            samples = sampler(path, rendering, draws)
            _check_samples(samples, path)
            values = FieldValues(torch.ones_like(samples.s), samples.positions.sigmoid())
            rendering = composite(samples, values, torch.zeros(NUM_RAYS, 3), path)
        return samples.s

    first = drawn(example_draws())
    _require(torch.equal(first, drawn(example_draws())), "samples are a function of the random numbers of the step")
    _require(not torch.equal(first, drawn(example_draws(step=1))), "samples are random in training")
    _require(torch.equal(drawn(None), drawn(None)), "samples repeat in evaluation")


def _check_samples(samples: Samples, path: Path) -> None:
    num_samples = samples.s.shape[1]
    _require(samples.edges.shape == (NUM_RAYS, num_samples + 1), "a sampler returns one edge more than samples")
    _require(bool((samples.s.diff(dim=1) >= 0).all()), "samples are sorted by arc length")
    _require(bool((samples.deltas >= 0).all()), "edges do not decrease")
    between = (samples.s >= samples.edges[:, :-1] - 1e-4) & (samples.s <= samples.edges[:, 1:] + 1e-4)
    _require(bool(between.all()), "samples lie between their edges")
    inside = (samples.s >= path.near[:, None] - 1e-4) & (samples.s <= path.far[:, None] + 1e-4)
    _require(bool(inside.all()), "samples lie between near and far")
    expected, _ = path.at(samples.s)
    _require(torch.allclose(samples.positions, expected, atol=1e-3), "positions lie on the path at arc length s")


def _check_field(field: Field) -> None:
    samples = example_samples()
    values = field(samples)
    _require(bool((values.density >= 0).all()), "density is not negative")
    _require(bool((values.radiance > -0.01).all()), "radiance is not negative")
    (values.density.sum() + values.radiance.sum()).backward()
    _require_gradients(field)


@torch.no_grad()
def _check_far_field(field: Field, space: Contracted) -> None:
    """Check a field with a grid over all of space, which varies in it and has a limit along each ray to infinity."""
    for parameter in field.parameters():  # many fields are constant at first
        parameter.add_(0.1 * torch.randn_like(parameter))
    path = straight_path(replace(example_rays(), origins=space.centre.expand(NUM_RAYS, 3)))
    samples = point_samples(path, space.radius * torch.tensor([30.0, 1e5, 2e5]).expand(NUM_RAYS, 3))
    values = field(samples)
    density = values.density / space.scale(samples.positions)
    close, far, farther = torch.cat([density[..., None], values.radiance], -1).unbind(1)
    _require(
        torch.allclose(far, farther, rtol=0.1, atol=1e-3),
        "density / space.scale and radiance have limits far away, because fields with needs_box are functions of "
        "space.contract(positions), and densities are per world unit",
    )
    varies = (close - far).abs().amax(-1) > 1e-4
    _require(
        bool(varies.float().median() > 0), "fields with needs_box cover all of space, as functions of space.contract"
    )


def _check_background(background: Background) -> None:
    directions = torch.nn.functional.normalize(torch.randn(4, 5, 3), dim=-1)
    radiance = background(Exits(directions))
    _require(bool((radiance > -0.01).all()), "radiance is not negative")
    exits = example_path().exits()
    _require(background(exits).shape == exits.directions.shape, "forward takes the exits of paths")
    if any(parameter.requires_grad for parameter in background.parameters()):
        radiance.sum().backward()
        _require_gradients(background)


def _check_loss(loss: Loss) -> None:
    scene = example_run().renderer.scene
    split = example_path(branches="all")
    for case, renderings, batch in (
        ("", [example_rendering(), example_rendering()], example_batch()),
        (" for rays that split, and pixels with two rays", [example_rendering(split)], example_batch(rays_per_pixel=2)),
        (" for empty pixels", [example_rendering(scale=0.0)], example_batch()),
        (" for opaque pixels", [example_rendering(scale=1e4)], example_batch()),
    ):
        with _named(f"a loss{case}"):
            value = loss(renderings, batch, scene)
        returned = "None" if value is None else type(value).__name__
        _require(isinstance(value, torch.Tensor), f"forward returned {returned}, not Tensor")
        _require(value.shape == (), f"a loss is a scalar{case}, and forward returned shape {list(value.shape)}")
        _require(bool(value.isfinite()), f"a loss is finite{case}")
        again = loss(renderings, batch, scene)
        _require(torch.equal(value, again), "a loss takes random numbers only from batch.draws")
        _require(
            value.requires_grad or float(value) == 0, "a loss depends on the renderings or on the scene with gradients"
        )
        if value.requires_grad:
            inputs = [t for each in renderings for t in (each.radiance, each.weights, each.transmittance)]
            gradients = torch.autograd.grad(value, [*inputs, *scene.parameters()], allow_unused=True)
            finite = all(bool(gradient.isfinite().all()) for gradient in gradients if gradient is not None)
            _require(finite, f"a loss has finite gradients{case}")


def _check_model(model: Renderer) -> None:
    renderings = model(example_rays())
    _require(len(renderings) >= 1, "forward returns a rendering for each level")
    _require(renderings[-1].radiance.shape == (NUM_RAYS, 3), "radiance is [R, 3]")
    renderings[-1].radiance.sum().backward()
    _require_gradients(model.scene.fields)
    rays = example_rays()
    missing = replace(rays, directions=-rays.directions)
    _require(
        torch.allclose(model.render(missing).radiance, model(missing)[-1].radiance, atol=1e-4),
        "evaluation renders rays that miss the field as render_path does; set empty_shows_background = False if they "
        "show more than the background",
    )


def _check_data(source: DataSource) -> None:
    _require(hasattr(source, "root"), "a data source has the attribute `root`, the folder of the data set")
    for split in source.splits:
        views = source.load(split)
        size = (views.cameras.height, views.cameras.width)
        _require(len(views.cameras) == len(views.images) == len(views), "there is a camera for each image")
        _require(all(image.shape == (*size, 3) for image in views.images), "images are [H, W, 3]")
        _require(views.masks is None or all(mask.shape == size for mask in views.masks), "masks are [H, W]")
        _require(
            views.usable is None or all(usable.shape == size for usable in views.usable), "usable pixels are [H, W]"
        )


def _check_metric(metric: ImageMetric) -> None:
    if metric.missing is not None:
        return
    size = max(metric.min_size, 32)
    target = torch.linspace(0.1, 1, size * size * 3).view(size, size, 3)
    columns = torch.arange(size).expand(size, size)
    different = target.flip(0)
    half_different = torch.where((columns < size // 2)[..., None], target, different)

    def score(prediction: torch.Tensor, inside: torch.Tensor | None = None, size: int = size) -> torch.Tensor:
        data, rendered = (
            {name: image[:size, :size] for name in ("depth", "opacity", "exit_directions", "normals", *metric.maps)}
            for image in (target, prediction)
        )
        maps = ViewMaps(data, rendered | {"refracted": torch.zeros(size, size, 1)})
        images = prediction[:size, :size], target[:size, :size]
        return metric(*images, inside, *([maps] if metric.maps else []))

    def is_better(first: torch.Tensor, second: torch.Tensor) -> bool:
        return bool(first > second if metric.better == "higher" else first < second)

    equal = score(target)
    _require(equal.shape == () and bool(equal.isfinite()), "a metric returns a finite scalar")
    _require(is_better(equal, score(different)), "equal images score better than different ones")
    masked = score(different, torch.ones(size, size, dtype=torch.bool))
    _require(math.isclose(masked, score(different), abs_tol=0.05), "a mask of all pixels does not change the score")
    masked = score(half_different, columns < size // 4)
    _require(is_better(masked, score(half_different)), "pixels outside of the mask `inside` do not count")
    smallest = score(different, size=metric.min_size)
    _require(bool(smallest.isfinite()), f"the score of an image of min_size = {metric.min_size} pixels is finite")
    errors = metric.error_map(different, target)
    _require(errors is None or errors.values.shape == (size, size), "an error map has one value for each pixel")


def _check_phase(phase: Phase) -> None:
    counts = [phase.steps_before(step) for step in range(1000)]
    _require(all(isinstance(count, int) and count >= 0 for count in counts), "steps_before returns integers from 0 on")
    for step, (earlier, later) in enumerate(itertools.pairwise(counts)):
        message = f"it returned {earlier} before step {step} and {later} before step {step + 1}"
        _require(earlier <= later, f"steps_before is cumulative: {message}")
    learned = [_after_step(phase, seed) for seed in range(2)]
    _require(all(map(torch.equal, *learned)), "random numbers of a step depend on its number, as those of run.batches")


def _after_step(phase: Phase, seed: int) -> list[torch.Tensor]:
    """Return all parameters after the first step of a phase, with a seed of other random numbers."""
    run = example_run()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        state = phase.begin(run)
        _require(isinstance(state, dict), f"begin returns a dictionary, not {state!r}")
        checkpoint = io.BytesIO()
        torch.save(state, checkpoint)
        checkpoint.seek(0)
        try:
            torch.load(checkpoint, weights_only=True)
        except pickle.UnpicklingError as error:
            raise ContractError("contract broken: begin returns tensors, numbers, texts, lists and dictionaries, which "
                                "a checkpoint can contain") from error  # fmt: skip
        taken = phase.step(run, 0, state)
    _require(isinstance(taken, bool), f"step returns True, or False to end the phase, not {taken!r}")
    parameters = list(run.renderer.parameters_by_name().values())
    _require(all(bool(parameter.isfinite().all()) for parameter in parameters), "parameters are finite after a step")
    return [parameter.detach() for parameter in parameters]


def _check_callback(callback: Any) -> None:
    # Importing Lightning takes seconds, and no other plugin needs Lightning.
    _require(hasattr(callback, "on_train_batch_end"), "a callback derives from lightning.pytorch.Callback")


_CONTRACTS: dict[str, tuple[type, Callable[[Any], None]]] = {
    "camera": (CameraModel, _check_camera),
    "medium": (Medium, _check_medium),
    "surface": (Surface, _check_surface),
    "sampler/path": (PathSampler, _check_path_sampler),
    "sampler/points": (PointSampler, _check_point_sampler),
    "field": (Field, _check_field),
    "background": (Background, _check_background),
    "loss": (Loss, _check_loss),
    "model": (Renderer, _check_model),
    "data": (DataSource, _check_data),
    "phase": (Phase, _check_phase),
    "callbacks": (object, _check_callback),
    "metric": (ImageMetric, _check_metric),
}


def _unit(directions: torch.Tensor) -> bool:
    return torch.allclose(directions.norm(dim=-1), torch.ones(directions.shape[:-1]), atol=1e-4)


def _require_gradients(module: torch.nn.Module) -> None:
    for name, parameter in module.named_parameters():
        if parameter.requires_grad:
            finite = parameter.grad is not None and bool(parameter.grad.isfinite().all())
            _require(finite, f"{name} gets a finite gradient")


def _require(condition: bool, contract: str) -> None:
    if not condition:
        raise ContractError(f"contract broken: {contract}")
