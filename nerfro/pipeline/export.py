"""Files of trained scenes for other programs: `nerfro.export`."""

from __future__ import annotations

from pathlib import Path

from nerfro.cli.calls import options_of
from nerfro.core.paths import user_path
from nerfro.files.atomic import refuse_existing
from nerfro.registry.allowed import refuse_unused
from nerfro.training.run import Run
from nerfro.training.run_folder import load
from nerfro.viewing.exports import ExportConfig, find_export


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
