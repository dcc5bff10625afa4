"""`python -m nerfro.export checkpoint=... what=mesh out=FILE`: write a trained scene for other programs.

Examples:
    nerfro export checkpoint=outputs/first what=page out=page.html
    nerfro export checkpoint=outputs/first what=mesh out=mesh.glb
"""

from __future__ import annotations

from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.core.paths import user_path
from nerfro.files.atomic import refuse_existing
from nerfro.registry.allowed import refuse_unused
from nerfro.training.load import load
from nerfro.viewing.exports import ExportConfig, find_export


@entry_point("export", ExportConfig)
def main(config: DictConfig) -> None:
    """Check the request, load the scene, and write the file."""
    out = user_path(config.out)
    export = find_export(config.what, out)
    refuse_unused(config, ExportConfig, export.unused, f"with what={config.what}")
    refuse_existing(export.files(out), config.overwrite)
    scene = load(config.checkpoint, config.device, config.root)
    if config.sky is not None:
        scene = scene.with_(sky=config.sky)
    written = export.write(scene, out, config)
    if scene.source.origin.any():
        written += f", in coordinates relative to the point {scene.source.origin.tolist()}"
    print(f"{written}; wrote {out}")


if __name__ == "__main__":
    main()
