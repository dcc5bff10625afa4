"""Pages of boards for printing in true size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from nerfro.capture.boards import Sheet
from nerfro.errors import NerfroError
from nerfro.files.atomic import atomic_file

_DOTS_PER_METRE = 300 / 0.0254
_MARGIN, _WIDEST = 0.008, 3.0  # metres


def print_sheets(sheets: list[Sheet], folder: Path) -> list[Path]:
    """Write board.pdf with one page per sheet, and the same pages as board_<number>.png.

    The unit of the board is interpreted as one metre. A page is a sheet with a margin, to be printed at 100 %.
    """
    pages, resolution = [], 0.0
    for sheet in sheets:
        # An integer number of pixels for each pixel of the sheet keeps edges sharp and in place.
        width = float(np.linalg.norm(sheet.corners[1] - sheet.corners[0]))
        if width > _WIDEST:
            message = f"the board is {width:g} m wide, the limit is {_WIDEST:g} m; give size= in metres"
            raise NerfroError(message)
        enlarged = max(1, round(width * _DOTS_PER_METRE / sheet.levels.shape[1]))
        levels = np.kron(sheet.levels, np.ones((enlarged, enlarged), np.uint8))
        per_metre = levels.shape[1] / width
        resolution = 0.0254 * per_metre
        margin = round(_MARGIN * per_metre)
        page = Image.fromarray(np.pad(levels, margin, constant_values=255))
        caption = f"{sheet.title}; {1000 * width:.1f} mm wide: print at 100 % and measure"
        size = 0.45 * margin
        size *= min(1, levels.shape[1] / ImageFont.load_default(size).getlength(caption))
        place = margin, page.height - margin / 2
        ImageDraw.Draw(page).text(place, caption, 0, ImageFont.load_default(size), anchor="lm")
        pages.append(page.convert("1", dither=Image.Dither.NONE))  # a PDF of grey levels would be lossy
    files = [folder / "board.pdf", *(folder / f"board_{number:02d}.png" for number in range(len(pages)))]
    with atomic_file(files[0]) as stream:
        pages[0].save(stream, "PDF", save_all=True, append_images=pages[1:], resolution=resolution)
    for file, page in zip(files[1:], pages, strict=True):
        with atomic_file(file) as stream:
            page.save(stream, "PNG", dpi=(resolution, resolution))
    return files
