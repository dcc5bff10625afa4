"""Tables of scores on the console, in CSV and in LaTeX."""

import csv
import io
import re

import pytest
import rich.console
from rich.cells import cell_len

from nerfro.evaluation.image_metrics import image_metrics
from nerfro.evaluation.results import EvaluationResult, RunMetrics, ViewScores
from nerfro.evaluation.tables import (
    Column,
    Row,
    Table,
    means_table,
    to_csv,
    to_latex,
    to_rich,
    views_table,
)

TABLE = Table(
    title="50% of a_b & c",
    label_title="method",
    columns=(
        Column("PSNR", "higher", 2, "A & co"),
        Column("LPIPS", "lower", 3, "A & co"),
        Column("PSNR", "higher", 2, "B"),
        Column("steps", None, 0, "B"),
    ),
    rows=(
        Row("mip_nerf|sky", (22.081, None, 1.0, 1500.0)),
        Row("w/o #H", (22.08, 0.25, 2.0, 1500.0), (0.5, None, None, None)),
        Row("refractive", (25.461, 0.1304, 3.0, 1500.0)),
        Row("straight", (21.8, 0.4, 4.0, 1500.0)),
    ),
    summary=(Row("mean", (22.8555, None, 2.5, 1500.0)),),
    medals=True,
    notes=("LPIPS n/a: no file at a_long_path/" + "x" * 100,),
)


def test_medals_follow_the_papers_rule() -> None:
    """Values that print alike have the same medal, and the next one is not left out."""
    assert [[TABLE.medal_of(i, j) or None for i in range(4)] for j in range(4)] == [
        ["silver", "silver", "gold", "bronze"],
        [None, "silver", "gold", "bronze"],
        [None, "bronze", "silver", "gold"],
        [None, None, None, None],
    ]


def test_csv_preserves_every_digit() -> None:
    lines = [line for line in to_csv(TABLE).splitlines() if not line.startswith("#")]
    heading, *body = csv.reader(lines)
    titles = ("A & co PSNR", "A & co LPIPS", "B PSNR", "B steps")
    assert heading == ["method", *(text for title in titles for text in (title, f"{title} std"))]
    for row, cells in zip((*TABLE.rows, *TABLE.summary), body, strict=True):
        numbers = tuple(None if cell == "n/a" else float(cell) for cell in cells[1:])
        assert (cells[0], numbers[::2]) == (row.label, row.values)
        assert numbers[1::2] == (row.spreads or (None,) * 4)


def test_latex_is_a_booktabs_table_with_special_characters_escaped() -> None:
    latex = to_latex(TABLE)
    assert re.search(r"(?<!\\)[_#%]|±", latex) is None
    assert r"\caption{50\% of a\_b \& c}" in latex
    assert latex.count("{") == latex.count("}")
    for rule in (r"\toprule", r"\midrule", r"\bottomrule", r"\cmidrule(lr){2-3} \cmidrule(lr){4-5}"):
        assert rule in latex
    body = latex[latex.index(r"\toprule") : latex.index(r"\bottomrule")]
    groups, headings, *rows = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert groups == r" & \multicolumn{2}{c}{A \& co} & \multicolumn{2}{c}{B} \\"
    assert headings == r"method & PSNR $\uparrow$ & LPIPS $\downarrow$ & PSNR $\uparrow$ & steps \\"
    assert [len(re.findall(r"(?<!\\)&", row)) for row in rows] == [4] * 5
    silver = r"\cellcolor[HTML]{DADDE2}"
    assert rows[1].startswith(rf"w/o \#H & {silver}22.08 $\pm$ 0.50 & {silver}0.250 & ")
    special = to_latex(Table("\\ ~ ^ { } $", "x", (Column("y"),), (Row("z", (1.0,)),)))
    assert r"\caption{\textbackslash{} \textasciitilde{} \textasciicircum{} \{ \} \$}" in special


def test_console_prints_a_table_for_each_group_of_columns() -> None:
    console = rich.console.Console(file=io.StringIO(), width=45)
    console.print(to_rich(TABLE))
    first, second = re.split(r"^ *B *$", console.file.getvalue(), flags=re.MULTILINE)
    for expected in ("50% of a_b & c", "A & co", "mip_nerf|sky", "22.08 ± 0.50 🥈", "0.130 🥇", "n/a", "mean"):
        assert expected in first
    assert "4.00 🥇" in second
    assert TABLE.notes[0] in second.replace("\n", "")
    assert "…" not in first + second


def test_console_prints_square_brackets_as_they_are() -> None:
    console = rich.console.Console(file=io.StringIO())
    console.print(to_rich(Table("t", "view", (Column("PSNR"),), (Row("[red]x", (1.0,)),))))
    assert "[red]x" in console.file.getvalue()


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


def test_one_table_has_the_means_of_regions_and_treatments_and_each_reason_once() -> None:
    """Scores of right halves are two rows of the same pixels."""
    table = means_table(RunMetrics(REGIONS), "means")
    assert table.rows == (line("full", 20.5), line("mask", 10.0), line("crop", 15.5))
    assert table.notes == ("SSIM n/a: crops too small", "LPIPS n/a: no network")
    treated = dict.fromkeys(("aligned", "unexposed", "exposed"), FULL_ONLY)
    labels = [row.label for row in means_table(RunMetrics(REGIONS, treatments=treated), "means").rows]
    assert labels[3:] == ["aligned", "unexposed, right halves", "exposed, right halves"]


@pytest.mark.parametrize("width", [40, 80])
def test_wide_table_keeps_names_and_numbers_on_a_narrow_console(width: int) -> None:
    label = "mip-NeRF on straight rays with an environment map (paper)"
    columns = tuple(Column(f"{name} of masks", "higher", 4) for name in ("PSNR", "SSIM", "LPIPS", "FLIP", "MAE"))
    numbers = tuple(12345.6789 + i for i in range(5))
    table = Table("t", "method", columns, (Row(label, numbers, numbers), Row("NeRF", numbers)), medals=True)
    console = rich.console.Console(width=width, file=io.StringIO())
    console.print(to_rich(table))
    lines = console.file.getvalue().splitlines()
    assert max(map(cell_len, lines)) <= width
    text = " ".join(lines)
    assert "…" not in text
    for number in numbers:
        assert text.count(f"{number:.4f}") == 3, "two numbers and a standard deviation"
    assert "NeRF " in text
    if width == 80:
        assert "mip-NeRF on straight rays" in text
