"""`python -m nerfro.render checkpoint=... path=orbit out=DIR`: render images and films of a trained scene.

Examples:
    nerfro render checkpoint=outputs/first path=orbit frames=60 out=outputs/orbit
    nerfro render checkpoint=outputs/first views=test what=depth out=outputs/depth
"""

from __future__ import annotations

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.pipeline.render import render
from nerfro.viewing.render_request import RenderConfig


@entry_point("render", RenderConfig)
def main(options: RenderConfig) -> None:
    """Check the request, load the scene, render the missing frames, and encode films."""
    render(options=options)


if __name__ == "__main__":
    main()
