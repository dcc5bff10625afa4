"""Images and films of trained scenes, and their files for other programs: `nerfro.render` and `nerfro.export`."""

from __future__ import annotations

from pathlib import Path

from nerfro.cli.calls import options_of
from nerfro.core.paths import user_path
from nerfro.files.atomic import lock_folder, refuse_existing
from nerfro.files.cache import file_hash
from nerfro.kernels.available import keep_freed_memory
from nerfro.registry.allowed import refuse_unused
from nerfro.training.run import Run
from nerfro.training.run_folder import checkpoint_of, load
from nerfro.viewing.exports import ExportConfig, find_export
from nerfro.viewing.film import LAYERS, find_ffmpeg, render_frames, write_film
from nerfro.viewing.render_request import RenderConfig, check_request, find_shots, prepared


def render(
    checkpoint: Run | str | Path | None = None, options: RenderConfig | None = None, **settings: object
) -> list[Path]:
    """Render images of a trained scene, and films of their sequence.

    Args:
        checkpoint: run, run folder or checkpoint.
        options: the options of `python -m nerfro.render`.
        **settings: options by name, as in `render(run, path="orbit", frames=60, out="outputs/orbit")`.

    Returns:
        The files of the frames in order, and of the films.

    Raises:
        NerfroError: options contradict each other, or the checkpoint cannot be read.
    """
    options = options_of(RenderConfig, options, settings, checkpoint=checkpoint)
    check_request(options)
    keep_freed_memory()
    folder = user_path(options.out)
    with lock_folder(folder, "out"):
        return _render(options, folder)


def _render(options: RenderConfig, folder: Path) -> list[Path]:
    scene = prepared(options, load(options.checkpoint, options.device, options.root))
    shots = find_shots(options, scene)
    inputs: list[str | Path] = [checkpoint_of(options.checkpoint), *([options.sky] if options.sky else [])]
    request = (options.what, scene.subdivision, *map(file_hash, inputs))
    films = [folder / f"film.{form}" for form in options.film if shots.film and options.format == "png"]
    if folder / "film.mp4" in films:
        find_ffmpeg()  # a missing ffmpeg is reported before the frames are rendered
    layer, suffix = LAYERS[options.what], f".{options.format}"
    frames = render_frames(layer, scene, shots, folder, suffix, request, options.overwrite)
    print(f"{len(frames)} frames: {frames[0]}")
    for film in films:
        write_film(film, frames, shots.seconds)
        print(f"film: {film}")
    return [*frames, *films]


def export(
    checkpoint: Run | str | Path | None = None,
    what: str | None = None,
    out: str | Path | None = None,
    options: ExportConfig | None = None,
    **settings: object,
) -> Path:
    """Write a trained scene for other programs, as in `export(run, "mesh", "mesh.glb")`.

    Args:
        checkpoint: run, run folder or checkpoint.
        what: content and kind of the file, such as `page`, `mesh` or `volume`.
        out: output file; its ending selects the format.
        options: the options of `python -m nerfro.export`.
        **settings: further options by name.

    Returns:
        The output file.

    Raises:
        NerfroError: an option is not allowed, the checkpoint cannot be read, or files exist.
    """
    options = options_of(ExportConfig, options, settings, checkpoint=checkpoint, what=what, out=out)
    file = user_path(options.out)
    exported = find_export(options.what, file)
    refuse_unused(options, exported.unused, f"with what={options.what}")
    refuse_existing(exported.files(file), options.overwrite)
    scene = load(options.checkpoint, options.device, options.root)
    if options.sky is not None:
        scene = scene.with_(sky=options.sky)
    written = exported.write(scene, file, options)
    if scene.source.origin.any():
        written += f", in coordinates relative to the point {scene.source.origin.tolist()}"
    print(f"{written}; wrote {file}")
    return file
