"""How near Mitsuba's pictures of an exported scene are to ours and to the photographs. Prints Markdown.

    python -m nerfro.export checkpoint=RUN what=mitsuba out=S/scene.xml
    python benchmarks/mitsuba_export.py RUN S/scene.xml

PSNR of whole pictures, ours with the run's own subdivision. `transmitting_glass` shows no partial reflection, as a
model that was trained with `sampler.path.branches=none`; `dielectric` is real glass.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import nerfro
from nerfro.core.light import to_srgb
from nerfro.evaluation.image_metrics import psnr
from nerfro.registry.registration import discover
from nerfro.synthetic.path_tracer import load_mitsuba

discover()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("exported", type=Path)
    parser.add_argument("--views", type=int, nargs="+", default=[0, 5, 10, 15, 19])
    parser.add_argument("--samples", type=int, default=64, help="a pixel, of Mitsuba's")
    arguments = parser.parse_args()
    mitsuba, scene = load_mitsuba(), nerfro.load(arguments.run)
    ours = scene.render(scene.cameras("test").select(arguments.views)).rgb
    photographs = scene.views("test").images
    print("| material | test view | against nerfro, dB | against the photograph, dB | nerfro against it, dB |")
    print("|---|---|---|---|---|")
    for glass in ("transmitting_glass", "dielectric"):
        loaded = mitsuba.load_file(str(arguments.exported), glass=glass)
        for view, rgb in zip(arguments.views, ours, strict=True):
            linear = np.array(mitsuba.render(loaded, sensor=view, spp=arguments.samples))[..., :3]
            picture, photograph = to_srgb(torch.from_numpy(linear)).clamp(0, 1), photographs[view]
            scores = (psnr(*pair) for pair in ((picture, rgb), (picture, photograph), (rgb, photograph)))
            print(f"| `{glass}` | {view} | {' | '.join(f'{float(score):.1f}' for score in scores)} |")


if __name__ == "__main__":
    main()
