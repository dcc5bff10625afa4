"""Calibration targets on paper, in their true size."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from nerfro.capture.targets import Sheet
from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically

_DOTS_PER_METRE = 300 / 0.0254
_MARGIN = 0.008  # metres
_WIDEST = 3.0  # metres


def print_sheets(sheets: list[Sheet], folder: Path) -> list[Path]:
    """Write board.pdf, a page for each sheet, and the same pages as board_<number>.png.

    The target's unit is taken for a metre. A page is a sheet with a margin, so it must be printed at 100 %.

    Returns:
        The files.

    Raises:
        NerfroError: a sheet is wider than any printer's.
    """
    pages, resolution = [], 0.0
    for sheet in sheets:
        # Whole pixels for each of the sheet's, so that its edges stay sharp and in place.
        width = float(np.linalg.norm(sheet.corners[1] - sheet.corners[0]))
        if width > _WIDEST:
            raise NerfroError(
                f"a board {width:g} m wide is not printed; give size in metres, for at most {_WIDEST:g} in all"
            )
        enlarged = max(1, round(width * _DOTS_PER_METRE / sheet.levels.shape[1]))
        levels = np.kron(sheet.levels, np.ones((enlarged, enlarged), np.uint8))
        per_metre = levels.shape[1] / width
        resolution = 0.0254 * per_metre
        margin = round(_MARGIN * per_metre)
        page = Image.fromarray(np.pad(levels, margin, constant_values=255))
        caption = f"{sheet.title}; {1000 * width:.1f} mm wide: print at 100 % and measure"
        size = 0.45 * margin
        font = ImageFont.load_default(size)
        size *= min(1, levels.shape[1] / font.getlength(caption))
        ImageDraw.Draw(page).text(
            (margin, page.height - margin / 2), caption, 0, ImageFont.load_default(size), anchor="lm"
        )
        pages.append(page.convert("1", dither=Image.Dither.NONE))  # a PDF of grey levels would be lossy
    files = [folder / "board.pdf"]
    content = io.BytesIO()
    pages[0].save(content, "PDF", save_all=True, append_images=pages[1:], resolution=resolution)
    write_atomically(files[0], content.getvalue())
    for number, page in enumerate(pages):
        files.append(folder / f"board_{number:02d}.png")
        content = io.BytesIO()
        page.save(content, "PNG", dpi=(resolution, resolution))
        write_atomically(files[-1], content.getvalue())
    return files
