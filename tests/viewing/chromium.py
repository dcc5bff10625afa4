"""Opening pages in headless Chromium with software WebGL2."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

needs_chromium = pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed")
OPTIONS = ("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
           "--hide-scrollbars", "--enable-logging=stderr")  # fmt: skip


def open_page(address: str, folder: Path, *options: str, size: tuple[int, int] = (900, 600)) -> str:
    """Open a page, and return what the browser writes to its output; nothing may stand in the page's console."""
    command = ["chromium", *OPTIONS, f"--user-data-dir={folder / 'profile'}", f"--window-size={size[0]},{size[1]}"]
    done = subprocess.run([*command, *options, address], capture_output=True, text=True, check=True, timeout=300)
    assert re.findall(r".*CONSOLE.*", done.stderr) == []
    return done.stdout


def ask(page: str, script: str, folder: Path) -> Any:
    """What a script finds in a page that has loaded: the value of its expression."""
    probe = f"""<script>window.addEventListener("load", () => {{
      const found = {script};
      for (const part of document.querySelectorAll("#arrays, script")) part.remove();
      document.body.dataset.found = JSON.stringify(found);
    }});</script></body>"""
    file = folder / "asked.html"
    file.write_text(page.replace("</body>", probe), encoding="utf-8")
    found = re.search(r"data-found=\"([^\"]*)\"", open_page(file.as_uri(), folder, "--dump-dom"))
    assert found
    return json.loads(html.unescape(found[1]))
