"""The page of a run shows costs, scores, the curve of the loss, and the best and the worst view."""

import re
from pathlib import Path

from nerfro.evaluation.results import EvaluationResult, RunMetrics, ViewScores
from nerfro.evaluation.run_page import write_run_page


def test_page_names_scores_views_files_and_commands(tmp_path: Path) -> None:
    views = tuple(ViewScores(f"r_{i}", {"psnr": psnr}) for i, psnr in enumerate((30.0, 34.25, 21.5)))
    (tmp_path / "metrics.md").touch()
    curve = [(1, 0.1, 1.0), (60, 50.0, 0.1), (130, 95.0, 0.01)]
    write_run_page(tmp_path, "refractive on <torus>", (1234, 95.0), curve, RunMetrics(EvaluationResult(views)), "test")
    page = (tmp_path / "index.html").read_text()
    assert "refractive on &lt;torus&gt;" in page
    assert "<dd>1 min 35 s</dd>" in page
    assert "<dd>1,234</dd>" in page
    assert "<dd>28.58</dd>" in page
    assert re.findall(r'src="(.*?)"', page) == ["images/test_002.png", "images/test_001.png"]
    assert re.findall(r'<a href="(.*?)"', page) == ["metrics.md"]
    # The loss falls by the same factor twice: on a logarithmic scale, the middle is half-way.
    assert 'points="1.1,2.0 526.3,50.0 1000.0,98.0"' in page
    assert f"nerfro.render checkpoint={tmp_path} path=orbit" in page


def test_page_without_scores_has_no_views(tmp_path: Path) -> None:
    write_run_page(tmp_path, "refractive", (0, 0.0), [], None, "")
    page = (tmp_path / "index.html").read_text()
    assert "<img" not in page
    assert "<svg" not in page
