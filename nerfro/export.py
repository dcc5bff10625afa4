"""`python -m nerfro.export checkpoint=... what=mesh out=FILE`: write a trained scene for other programs.

Examples:
    nerfro export checkpoint=outputs/first what=page out=page.html
    nerfro export checkpoint=outputs/first what=mesh out=mesh.glb
"""

from __future__ import annotations

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.pipeline.export import export
from nerfro.viewing.exports import ExportConfig


@entry_point("export", ExportConfig)
def main(options: ExportConfig) -> None:
    """Check the request, load the scene, and write the file."""
    export(options=options)


if __name__ == "__main__":
    main()
