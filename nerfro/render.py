"""`python -m nerfro.render checkpoint=... path=orbit out=DIR`: render images and films of a trained scene.

Examples:
    nerfro render checkpoint=outputs/first path=orbit frames=60 out=outputs/orbit
    nerfro render checkpoint=outputs/first views=test what=depth out=outputs/depth
"""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.core.paths import CONF_DIR, user_path
from nerfro.files.cache import file_hash
from nerfro.files.folder_lock import lock_folder
from nerfro.kernels.allocator import keep_freed_memory
from nerfro.training.load import checkpoint_of, load
from nerfro.viewing.film import find_ffmpeg, write_film
from nerfro.viewing.frames import render_frames
from nerfro.viewing.layers import LAYERS
from nerfro.viewing.render_request import RenderConfig, check_request, find_shots, prepared


@entry_point("render", RenderConfig, CONF_DIR / "render")
def main(config: DictConfig) -> None:
    """Check the request, load the scene, render the missing frames, and encode films."""
    check_request(config)
    keep_freed_memory()
    with lock_folder(user_path(config.out), "out"):
        _render(config, user_path(config.out))


def _render(config: DictConfig, folder: Path) -> None:
    scene = prepared(config, load(config.checkpoint, config.device, config.root))
    shots = find_shots(config, scene)
    inputs = [checkpoint_of(config.checkpoint), *([config.sky] if config.sky else [])]
    request = (config.what, scene.subdivision, *map(file_hash, inputs))
    films = config.film if shots.film and config.format == "png" else []
    if "mp4" in films:
        find_ffmpeg()  # a missing ffmpeg is reported before the frames are rendered
    files = render_frames(LAYERS[config.what], scene, shots, folder, f".{config.format}", request, config.overwrite)
    print(f"{len(files)} frames: {files[0]}")
    for form in films:
        film = folder / f"film.{form}"
        write_film(film, files, config.seconds)
        print(f"film: {film}")


if __name__ == "__main__":
    main()
