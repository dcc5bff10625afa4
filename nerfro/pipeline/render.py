"""Images and films of trained scenes: `nerfro.render`."""

from __future__ import annotations

from pathlib import Path

from nerfro.cli.calls import options_of
from nerfro.core.paths import user_path
from nerfro.files.atomic import lock_folder
from nerfro.files.cache import file_hash
from nerfro.kernels.available import keep_freed_memory
from nerfro.training.run import Run
from nerfro.training.run_folder import checkpoint_of, load
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
