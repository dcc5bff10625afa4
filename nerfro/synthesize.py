"""`python -m nerfro.synthesize scene=torus`: render the ground truth of a synthetic scene with Mitsuba 3.

Examples:
    nerfro synthesize scene=torus resolution=128 out=outputs/scenes/torus
    nerfro synthesize scene=glass.glb sky=room.hdr cameras=above
"""

from __future__ import annotations

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.synthetic.options import SynthesizeConfig
from nerfro.synthetic.synthesis import synthesize


@entry_point("synthesize", SynthesizeConfig)
def main(options: SynthesizeConfig) -> None:
    """Render the missing images, and print the next command."""
    data = synthesize(options)
    print(f"done: {data.folder}")
    print(data.next_command())


if __name__ == "__main__":
    main()
