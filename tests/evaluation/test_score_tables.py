from nerfro.evaluation.image_metrics import image_metrics
from nerfro.evaluation.results import EvaluationResult, ViewScores
from nerfro.evaluation.tables import Row, regions_table, views_table


def scores(psnr: float | None) -> dict[str, float | None]:
    """PSNR, a FLIP of half, and nothing else."""
    return {name: {"psnr": psnr, "flip": 0.5}.get(name) for name in image_metrics()}


def line(label: str, psnr: float) -> Row:
    return Row(label, (psnr, 0.5))


FULL_ONLY = EvaluationResult(
    tuple(ViewScores(f"test_{i:03d}", scores(20.0 + i)) for i in range(2)), {"lpips": "no network"}
)
REGIONS = EvaluationResult(
    tuple(ViewScores(f"r_{i}", scores(20.0 + i), {"mask": scores(10.0), "crop": scores(15.0 + i)}) for i in range(2)),
    {"lpips": "no network", "ssim": "crops too small"},
)


def test_views_table_has_a_row_for_each_view_and_their_mean() -> None:
    table = views_table(FULL_ONLY, "test views")
    assert [column.title for column in table.columns] == ["PSNR", "FLIP"], "no column without a number"
    assert table.rows == (line("test_000", 20.0), line("test_001", 21.0))
    assert table.summary == (line("mean", 20.5),)
    assert table.notes == ("LPIPS n/a: no network",)


def test_regions_table_has_their_means_and_each_reason_once() -> None:
    table = regions_table(REGIONS, "means")
    assert table.rows == (line("full", 20.5), line("mask", 10.0), line("crop", 15.5))
    assert table.notes == ("SSIM n/a: crops too small", "LPIPS n/a: no network")
