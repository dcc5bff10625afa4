import csv
import io
import re

import pytest
import rich.console

from nerfro.errors import NerfroError
from nerfro.evaluation.tables import (
    Column,
    Row,
    Table,
    to_csv,
    to_latex,
    to_markdown,
    to_rich,
)

TABLE = Table(
    title="50% of a_b & c",
    label_title="method",
    columns=(Column("PSNR", "higher", 2), Column("LPIPS", "lower", 3), Column("steps", None, 0)),
    rows=(
        Row("mip_nerf|sky", (22.314999, None, 1500.0)),
        Row("refractive", (25.461, 0.1304, 1500.0)),
        Row("w/o #H", (25.4579, 0.25, 1500.0)),
    ),
    summary=(Row("mean", (24.41, None, 1500.0)),),
    mark="best",
    notes=("LPIPS n/a: no file at a_long_path/" + "x" * 100,),
)


def best_cells(table: Table) -> set[tuple[int, int]]:
    return {(i, j) for i in range(len(table.rows)) for j in range(len(table.columns)) if table.mark_of(i, j) == "best"}


def on_console(table: Table, styled: bool = False) -> str:
    console = rich.console.Console(file=io.StringIO(), width=400, force_terminal=styled, color_system="standard")
    console.print(to_rich(table))
    return console.file.getvalue()


def test_best_follows_the_direction_of_the_column_and_values_that_print_alike_tie() -> None:
    assert best_cells(TABLE) == {(1, 0), (2, 0), (1, 1)}


def test_csv_reads_back_every_digit() -> None:
    lines = [line for line in to_csv(TABLE).splitlines() if not line.startswith("#")]
    heading, *body = csv.reader(lines)
    assert heading == ["method", "PSNR", "LPIPS", "steps"]
    for row, cells in zip((*TABLE.rows, *TABLE.summary), body, strict=True):
        assert cells[0] == row.label
        assert tuple(None if cell == "n/a" else float(cell) for cell in cells[1:]) == row.values


def test_markdown_has_as_many_cells_in_every_line() -> None:
    lines = [line for line in to_markdown(TABLE).splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    assert {len(row) for row in cells} == {4}
    assert cells[0] == ["method", "PSNR ↑", "LPIPS ↓", "steps"]
    assert cells[2] == [r"mip_nerf\|sky", "22.31", "n/a", "1500"]
    assert cells[3] == ["refractive", "**25.46**", "**0.130**", "1500"]
    assert cells[5] == ["*mean*", "*24.41*", "*n/a*", "*1500*"]


def test_latex_is_a_booktabs_table_with_special_characters_escaped() -> None:
    latex = to_latex(TABLE)
    assert re.search(r"(?<!\\)[_#%]", latex) is None
    assert r"\caption{50\% of a\_b \& c}" in latex
    assert latex.count("{") == latex.count("}")
    for rule in (r"\toprule", r"\midrule", r"\bottomrule"):
        assert rule in latex
    body = latex[latex.index(r"\toprule") : latex.index(r"\bottomrule")]
    rows = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert [len(re.findall(r"(?<!\\)&", row)) for row in rows] == [3] * 5
    assert rows[0] == r"method & PSNR $\uparrow$ & LPIPS $\downarrow$ & steps \\"
    assert rows[2] == r"refractive & \textbf{25.46} & \textbf{0.130} & 1500 \\"


def test_latex_prints_every_special_character_as_itself() -> None:
    latex = to_latex(Table("\\ ~ ^ { } $", "x", (Column("y"),), (Row("z", (1.0,)),)))
    assert r"\caption{\textbackslash{} \textasciitilde{} \textasciicircum{} \{ \} \$}" in latex


def test_console_shows_every_number_and_the_footnote_in_one_line() -> None:
    text = on_console(TABLE)
    for expected in ("50% of a_b & c", "mip_nerf|sky", "22.31", "0.130", "n/a", "mean", TABLE.notes[0]):
        assert expected in text
    assert re.search(r"\x1b\[1m[^\x1b]*25\.46", on_console(TABLE, styled=True))


def test_console_prints_square_brackets_as_they_are() -> None:
    assert "[red]x" in on_console(Table("t", "view", (Column("PSNR"),), (Row("[red]x", (1.0,)),)))


@pytest.mark.parametrize("row", [Row("a", (1.0,)), Row("a", (1.0, 2.0), (0.1,))])
def test_values_and_spreads_that_do_not_fit_the_columns_are_refused(row: Row) -> None:
    with pytest.raises(NerfroError, match="1 values of 'a' for 2 columns"):
        Table("t", "view", (Column("x"), Column("y")), (row,))
