"""Cost and quality of the interactive page of a run, in headless Chromium. Prints Markdown.

    python benchmarks/page.py RUN
    python benchmarks/page.py RUN --shaders OLD/trace.glsl nerfro/assets/_page/trace.glsl

The page and nerfro render the same test cameras with one ray through the centre of each pixel. The shader counts its
texture fetches, by macros in place of `texelFetch` and `textureLod`; the fetches of the sky, one for each path, are not
counted. The time of a frame is the processor time of the browser, which renders in software (SwiftShader), so it does
not depend on other programs. PSNR is that of the page against nerfro: of all pixels, of the pixels whose ray meets the
glass, and of those of the latter whose content has an opacity above one half.
"""

from __future__ import annotations

import argparse
import base64
import math
import os
import tempfile
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import nerfro
from nerfro.core.paths import ASSETS_DIR
from nerfro.evaluation.image_metrics import psnr
from nerfro.samplers.subdivision import Subdivision
from nerfro.viewing.page import make_page
from nerfro.viewing.trained_scene import RenderedViews
from nerfro.viewing.volume import RESOLUTION
from tests.viewing.browser import SHOT, Browser

SHADER = ASSETS_DIR / "_page" / "trace.glsl"
TEXTURES = ("coefficients", "clearance", "volume", "occupied")
# A function of the page, see `SHOT`.
COUNT = """
const count = (camera, size) => {
  const { gl, targets } = page.tracer;
  shot(camera, size);
  gl.bindFramebuffer(gl.FRAMEBUFFER, targets.traced.buffer);
  const numbers = new Float32Array(4 * size * size);
  gl.readPixels(0, 0, size, size, gl.RGBA, gl.FLOAT, numbers);
  return encode(numbers);
};
page.requestFrame = () => {};
"""


def main() -> None:
    """Print a table for each shader: a row for each view, and one of the means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--views", type=int, nargs="+", default=[0, 5, 10, 15, 19])
    parser.add_argument("--size", type=int, default=128, help="pixels per side")
    parser.add_argument("--resolution", type=int, default=RESOLUTION, help="of the volume of the page")
    parser.add_argument("--turns", type=int, default=3, help="frames of each view, of which the fastest counts")
    parser.add_argument("--shaders", type=Path, nargs="+", default=[SHADER], help="versions of trace.glsl")
    arguments = parser.parse_args()
    scene, views, size = nerfro.load(arguments.run), arguments.views, arguments.size
    original = make_page(scene, arguments.resolution)
    expected = scene.render(scene.cameras("test").select(views).resized(size, size), Subdivision())
    print(f"page of {len(original) / 1e6:.2f} MB, frames of {size}x{size} pixels")
    for shader in arguments.shaders:
        page = original.replace(SHADER.read_text(encoding="utf-8"), shader.read_text(encoding="utf-8"))
        counts, _ = ask(counting(page), "count", views, size, 1)
        fetches = np.stack([decoded(text, np.float32, size) for text in counts]).mean((1, 2))
        texts, seconds = ask(page, "shot", views, size, arguments.turns)
        shown = [torch.from_numpy(decoded(text, np.uint8, size)[..., :3] / 255).float() for text in texts]
        scores = [region_scores(rgb, expected, number) for number, rgb in enumerate(shown)]
        rows = np.column_stack([fetches.sum(1), fetches, seconds, scores])
        print(
            f"\n| view | fetches per pixel | {' | '.join(TEXTURES)} | s per frame | all, dB | glass, dB | content, dB |"
        )
        print("|---|" + "---|" * 9)
        for name, row in (*zip(views, rows, strict=True), ("mean", rows.mean(0))):
            scored = ("n/a" if math.isnan(score) else f"{score:.1f}" for score in row[6:])  # a region may be empty
            figures = [*(f"{number:.0f}" for number in row[:5]), f"{row[5]:.2f}", *scored]
            print(f"| {name} | {' | '.join(figures)} |", flush=True)


def counting(page: str) -> str:
    """Return the page with a shader whose colour is the number of fetches from each texture."""
    before, begin, rest = page.partition('<script type="text/plain" id="trace.glsl">')
    shader, end, after = rest.partition("</script>")
    declarations = ["out vec4 colour;", "vec4 fetches = vec4(0.0);"]
    for counter, texture in zip("xyzw", TEXTURES, strict=True):
        function = "textureLod" if texture == "volume" else "texelFetch"
        shader = shader.replace(f"{function}({texture},", f"fetch_{texture}(")
        counted = f"(++fetches.{counter}, {function}({texture}, at, level))"
        declarations.append(f"#define fetch_{texture}(at, level) {counted}")
    shader = shader.replace("out vec4 colour;", "\n".join(declarations))
    shader = shader.replace("void main() {", "void trace() {") + "void main() {\n  trace();\n  colour = fetches;\n}\n"
    return f"{before}{begin}{shader}{end}{after}"


def ask(page: str, function: str, views: list[int], size: int, turns: int) -> tuple[list[str], list[float]]:
    """Call `shot` or `count` for each view; returns the results, and the processor seconds of the browser."""
    texts, seconds = [], []
    with tempfile.TemporaryDirectory() as folder, Browser(page, Path(folder)) as browser:
        browser.evaluate(SHOT + COUNT)
        browser.evaluate(f"{function}({views[0]}, {size})")  # includes the compilation of the shader
        for view in views:
            times = [processor_seconds(browser.pid)]
            for _ in range(turns):
                text = browser.evaluate(f"{function}({view}, {size})")
                times.append(processor_seconds(browser.pid))
            texts.append(text)
            seconds.append(float(np.diff(times).min()))
    return texts, seconds


def processor_seconds(process: int) -> float:
    """Return the processor time of a process and its descendants."""
    parents, ticks = {}, {}
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            values = file.read_text().rpartition(")")[2].split()
        except OSError:  # the process has ended
            continue
        number = int(file.parent.name)
        parents[number], ticks[number] = int(values[1]), int(values[11]) + int(values[12])

    def descends(number: int) -> bool:
        return number == process or (number in parents and descends(parents[number]))

    return sum(ticks[number] for number in ticks if descends(number)) / os.sysconf("SC_CLK_TCK")


def decoded(text: str, kind: type, size: int) -> np.ndarray:
    """Decode the pixels that a function of `SHOT` or `COUNT` returns, top row first."""
    return np.frombuffer(base64.b64decode(text), kind).reshape(size, size, 4)[::-1].astype(np.float64)


def region_scores(shown: Float[Tensor, "H W 3"], view: RenderedViews, number: int) -> list[float]:
    """Return the PSNR of the page against nerfro in each region, in dB."""
    glass = view.normals[number].any(-1)
    regions = torch.ones_like(glass), glass, glass & (view.opacity[number] > 0.5)
    return [float(psnr(shown, view.rgb[number], region)) for region in regions]


if __name__ == "__main__":
    main()
