"""Surface and refractive index of a photographed object: from the options of `nerfro.preprocess` to the scene file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from nerfro.capture.index_search import FoundMedium, find_medium, initial_medium
from nerfro.capture.object_errors import observed_light, unsupported_bodies
from nerfro.capture.preprocess_options import MESH, PreprocessConfig, Request, surface_settings, write_scene
from nerfro.capture.refinement import refine
from nerfro.capture.surroundings import Observations
from nerfro.capture.vessel_fit import find_vessel
from nerfro.cli.calls import composed
from nerfro.cli.overrides import as_overrides
from nerfro.core.provenance import AlgorithmSettings
from nerfro.data.base import Views
from nerfro.data.capture import Capture
from nerfro.data.masks import EVIDENCE, REVOLUTION, masked_views, method_of, with_other_splits
from nerfro.files.atomic import lock_folder
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.bodies import COLOURS
from nerfro.registry.allowed import plain
from nerfro.rendering.scene_file import Provenance, SceneFile, with_scene
from nerfro.silhouettes.agreement import choose_wrong_masks, report_overlaps, require_consistent_poses
from nerfro.silhouettes.surface import make_mesh, read_silhouettes
from nerfro.silhouettes.visual_hull import Silhouettes


def preprocess(capture: Capture, overrides: Sequence[str] = (), **settings: object) -> SceneFile:
    """Reconstruct the surface of an object, estimate its refractive index, and write the scene file.

    Args:
        capture: photographs with poses and masks.
        overrides: settings as on the command line of `python -m nerfro.preprocess`, such as `["medium.ior=1.33"]`.
        **settings: options by name, as in `preprocess(capture, refine=True, out="surface")`.

    Returns:
        The content of the scene file, `scene.json` in the output folder.

    Raises:
        NerfroError: options contradict each other, the masks determine no surface, or files exist.
    """
    arguments = [*capture.overrides, *as_overrides(settings), *overrides]
    with composed("preprocess", PreprocessConfig, arguments, with_scene) as composition:
        return preprocess_composed(Request(**vars(composition)))


@torch.no_grad()
def preprocess_composed(request: Request) -> SceneFile:
    """Reconstruct surface and index for composed options, see `preprocess`."""
    AlgorithmSettings.used.clear()
    request.check()
    with lock_folder(request.out, "data.root" if request.config.out is None else "out"):
        return _preprocess(request)


def _preprocess(request: Request) -> SceneFile:
    config = request.config
    source, mesh = request.read()
    request.clear_files()
    views, silhouettes = masked_views(source.load("train")), None
    outlined = with_other_splits(views, source, "train")
    if mesh is None or outlined.masks is not None:
        mesh, outlined, silhouettes = _fit_surface(request, outlined, mesh)
    location = config.mesh or str(request.out / MESH)
    settings = surface_settings(request, views.cameras, mesh, source.origin)
    medium = initial_medium(request, location, settings)
    observations = Observations(views, mesh, config.room, medium.origin - source.origin)
    indexed = find_medium(request, observations, medium)
    if config.refine:
        carved, location = mesh, str(request.out / MESH)
        if indexed.provenance.doubts:
            print("surface not refined, because the photographs do not determine the index")
        else:
            mesh = refine(observations, mesh, indexed.medium, silhouettes, request.searches_index, request.out)
        mesh.relative_to(-source.origin).save(request.out / MESH)
        settings = surface_settings(request, views.cameras, mesh, source.origin)
        if mesh is not carved:
            if silhouettes is not None:
                report_overlaps(outlined, mesh, silhouettes, None, request.out, list_all=False)
            medium = initial_medium(request, location, settings)
            if (medium.origin != indexed.medium.origin).any():
                observations = Observations(views, mesh, config.room, medium.origin - source.origin)
            indexed = find_medium(request, observations, medium)
    vessel, unsupported = dict[str, object](), list[str]()
    if config.vessel:
        solid = indexed.medium.bodies
        assert solid is not None  # see Request.check
        vessel, fitted = find_vessel(solid, plain(config.medium) | {"mesh": location}, mesh, observations)
        unsupported = unsupported_bodies(observations, solid, bool(indexed.provenance.doubts), fitted)
    estimated = settings | {"mesh": location} | indexed.index_settings
    origin = replace(_with_absorption_and_reflection(request, observations, indexed), unsupported=unsupported)
    scene = SceneFile(medium=estimated, vessel=vessel, surroundings=observations.distance, provenance=origin)
    return write_scene(request, scene, views.cameras, mesh)


def _with_absorption_and_reflection(request: Request, observations: Observations, indexed: FoundMedium) -> Provenance:
    """Measure and print reflection and absorption, unless the index is given or doubtful, and record them."""
    bodies, origin = indexed.medium.bodies, indexed.provenance
    if bodies is None or not request.searches_index or origin.doubts:
        return origin
    light = observed_light(observations, bodies)
    shares = ", ".join(f"{share:.0%} of {name}" for share, name in zip(light.absorbed, COLOURS, strict=True))
    print(f"absorbed along the mean path: {shares} light; partial reflection is {'' if light.reflects else 'not '}seen")
    return replace(origin, absorbed=light.absorbed, reflects=light.reflects)


def _fit_surface(request: Request, views: Views, mesh: TriangleMesh | None) -> tuple[TriangleMesh, Views, Silhouettes]:
    """Carve and fit the surface unless a mesh is given, and compare it with the masks.

    Masks that are projections of a hull carry the shape of this hull, but are no evidence about the object.

    Returns:
        The surface, the views whose masks are no projections, and the silhouettes of these masks.
    """
    config, folder = request.config, request.out
    all_silhouettes = read_silhouettes(views, is_bounded=mesh is not None or request.box is not None)
    methods = [None if frame.mask is None else method_of(frame.mask) for frame in views.frames]
    own = [i for i, method in enumerate(methods) if method in EVIDENCE]
    silhouettes, num_projections = all_silhouettes, len(views) - len(own)
    if own and num_projections:
        views, silhouettes = views.select(own), all_silhouettes.select(own)
        print(f"{num_projections} masks are projections of a hull, which shape the surface but are no evidence")
    wrong_masks = choose_wrong_masks(silhouettes, config.wrong_masks)
    require_consistent_poses(silhouettes, views.names, wrong_masks)
    surface = mesh
    if surface is None:
        options = config.resolution, wrong_masks, config.keep, config.smoothing, config.symmetry
        surface = make_mesh(all_silhouettes, request.box, *options, silhouettes, REVOLUTION in methods)
        surface.save(folder / MESH)
    # The report is written before the medium is built, because the report shows why a medium refuses a surface.
    report_overlaps(views, surface, silhouettes, wrong_masks if mesh is None else None, folder)
    return surface, views, silhouettes
