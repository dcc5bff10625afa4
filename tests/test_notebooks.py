"""The notebooks of the docs run from top to bottom.

Their cells are plain Python, so they are executed here without a Jupyter kernel.
"""

import json
import linecache
from pathlib import Path
from typing import Any

import pytest

from nerfro.paths import PACKAGE_DIR

NOTEBOOKS = sorted((PACKAGE_DIR.parent / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.skipif(not NOTEBOOKS, reason="there is no checkout with docs")
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(notebook: Path, trained_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib.pyplot as plt

    monkeypatch.setenv("NERFRO_RUN", str(trained_run))
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")
    document = json.loads(notebook.read_text(encoding="utf-8"))
    assert document["nbformat"] == 4
    cells = ["".join(cell["source"]) for cell in document["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 2
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for number, source in enumerate(cells):
        name = f"{notebook.name}, cell {number}"
        linecache.cache[name] = len(source), None, source.splitlines(keepends=True), name  # for tracebacks
        exec(compile(source, name, "exec"), namespace)
    assert len(plt.get_fignums()) >= 3, "it draws pictures"
    plt.close("all")
