"""Tables of scores in memory, and their forms on paper: console, CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import rich.box
import rich.console
import rich.table
import rich.text

from nerfro.errors import NerfroError
from nerfro.evaluation.files import write_atomically
from nerfro.evaluation.results import METRICS, EvaluationResult, Score

MISSING = "n/a"


@dataclass(frozen=True)
class Column:
    """One column of numbers.

    Attributes:
        title: heading.
        better: which values are better; None if the column is not a competition.
        decimals: digits after the point, in all forms but CSV, which keeps every digit.
    """

    title: str
    better: Literal["higher", "lower"] | None = None
    decimals: int = 2


@dataclass(frozen=True)
class Row:
    """One line of a table: what it is about, and a number for each column; None where there is none."""

    label: str
    values: tuple[Score, ...]


@dataclass(frozen=True)
class Table:
    """A table of numbers.

    Attributes:
        title: what it shows.
        label_title: heading of the rows' labels.
        columns: headings and meaning of the numbers.
        rows: the lines, in order.
        summary: lines below a rule, such as means.
        mark_best: whether the best values of each column among `rows` are emphasised.
        notes: footnotes, such as the reason for a missing number.
    """

    title: str
    label_title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    summary: tuple[Row, ...] = ()
    mark_best: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for row in (*self.rows, *self.summary):
            if len(row.values) != len(self.columns):
                raise NerfroError(
                    f"table {self.title!r}: {len(row.values)} values of {row.label!r} for {len(self.columns)} columns"
                )

    def is_best(self, row: int, column: int) -> bool:
        """Whether a value of `rows` is the best of its column, or equal to it as printed.

        Values that print alike are marked alike: a reader cannot see a difference between them.
        """
        better, decimals = self.columns[column].better, self.columns[column].decimals
        value = self.rows[row].values[column]
        if not self.mark_best or better is None or value is None:
            return False
        present = [other.values[column] for other in self.rows]
        rivals = [round(other, decimals) for other in present if other is not None]
        return round(value, decimals) == (max(rivals) if better == "higher" else min(rivals))


def views_table(result: EvaluationResult, title: str) -> Table:
    """The scores of each view, and their means below.

    Args:
        result: what an evaluation found.
        title: heading of the table.

    Returns:
        A row for each view, with a footnote for each metric that is missing.
    """
    names = [metric.name for metric in METRICS]
    rows = tuple(Row(view.name, tuple(view.scores.get(name) for name in names)) for view in result.views)
    mean = Row("mean", tuple(result.mean(name) for name in names))
    return Table(title, "view", _metric_columns(), rows, summary=(mean,), notes=_notes({"": result}))


def means_table(results: Mapping[str, EvaluationResult], title: str, label_title: str = "method") -> Table:
    """The mean scores of several methods, the best of each metric marked.

    Args:
        results: what an evaluation found, by method.
        title: heading of the table.
        label_title: what the rows are, if not methods.

    Returns:
        A row for each method, with a footnote for each metric that is missing.
    """
    rows = tuple(Row(name, tuple(result.means.values())) for name, result in results.items())
    return Table(title, label_title, _metric_columns(), rows, mark_best=len(rows) > 1, notes=_notes(results))


def to_rich(table: Table) -> rich.console.Group:
    """Lay a table out for the console, `rich.print(to_rich(table))`; best values bold, footnotes below."""
    drawn = rich.table.Table(title=rich.text.Text(table.title), box=rich.box.SIMPLE_HEAD)
    drawn.add_column(rich.text.Text(table.label_title))
    for column in table.columns:
        drawn.add_column(rich.text.Text(_heading(column)), justify="right", no_wrap=True)
    for i, row in enumerate(table.rows):
        cells = [
            rich.text.Text(_cell(value, table.columns[j]), style="bold" if table.is_best(i, j) else "")
            for j, value in enumerate(row.values)
        ]
        drawn.add_row(rich.text.Text(row.label), *cells, end_section=i == len(table.rows) - 1)
    for row in table.summary:
        cells = [rich.text.Text(_cell(value, column)) for value, column in zip(row.values, table.columns, strict=True)]
        drawn.add_row(rich.text.Text(row.label), *cells, style="bold")
    # Footnotes are no caption of the drawn table: that would be wrapped to the table's width.
    return rich.console.Group(drawn, *(rich.text.Text(note, style="dim") for note in table.notes))


def to_csv(table: Table) -> str:
    """Write a table as CSV: every digit, no marks; footnotes as last lines that begin with `#`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([table.label_title, *(column.title for column in table.columns)])
    for row in (*table.rows, *table.summary):
        writer.writerow([row.label, *(MISSING if value is None else repr(value) for value in row.values)])
    return text.getvalue() + "".join(f"# {note}\n" for note in table.notes)


def to_markdown(table: Table) -> str:
    """Write a table as GitHub-flavoured Markdown: best values bold, summary rows in italics, footnotes below."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    lines = [f"**{table.title}**", "", line([table.label_title, *(_heading(column) for column in table.columns)])]
    lines.append("|" + "|".join([":---", *("---:" for _ in table.columns)]) + "|")
    for i, row in enumerate(table.rows):
        cells = [_cell(value, column) for value, column in zip(row.values, table.columns, strict=True)]
        marked = [f"**{cell}**" if table.is_best(i, j) else cell for j, cell in enumerate(cells)]
        lines.append(line([row.label, *marked]))
    for row in table.summary:
        cells = [_cell(value, column) for value, column in zip(row.values, table.columns, strict=True)]
        lines.append(line([f"*{row.label}*", *(f"*{cell}*" for cell in cells)]))
    lines += [text for note in table.notes for text in ("", note)]
    return "\n".join(lines) + "\n"


def to_latex(table: Table) -> str:
    r"""Write a table as LaTeX; the document needs `\usepackage{booktabs}`.

    Best values are bold, summary rows stand below a rule, footnotes below the table.
    """
    arrows = {"higher": r" $\uparrow$", "lower": r" $\downarrow$", None: ""}
    headings = [_latex(table.label_title), *(_latex(c.title) + arrows[c.better] for c in table.columns)]
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{_latex(table.title)}}}"]
    lines += [rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}", r"\toprule", _latex_row(headings), r"\midrule"]
    for i, row in enumerate(table.rows):
        cells = [_cell(value, column) for value, column in zip(row.values, table.columns, strict=True)]
        marked = [rf"\textbf{{{cell}}}" if table.is_best(i, j) else cell for j, cell in enumerate(cells)]
        lines.append(_latex_row([_latex(row.label), *marked]))
    if table.summary:
        lines.append(r"\midrule")
    for row in table.summary:
        cells = [_cell(value, column) for value, column in zip(row.values, table.columns, strict=True)]
        lines.append(_latex_row([_latex(row.label), *cells]))
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += [rf"\par\smallskip{{\footnotesize {_latex(note)}}}" for note in table.notes]
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def write_table(table: Table, stem: Path | str) -> list[Path]:
    """Write `<stem>.csv`, `<stem>.md` and `<stem>.tex`.

    Args:
        table: what to write.
        stem: path without suffix.

    Returns:
        The three paths.

    Raises:
        NerfroError: if a file cannot be written.
    """
    stem = Path(stem)
    texts = {".csv": to_csv(table), ".md": to_markdown(table), ".tex": to_latex(table)}
    paths = [stem.with_name(stem.name + suffix) for suffix in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        write_atomically(path, text)
    return paths


def _metric_columns() -> tuple[Column, ...]:
    return tuple(Column(metric.title, metric.better, metric.decimals) for metric in METRICS)


def _notes(results: Mapping[str, EvaluationResult]) -> tuple[str, ...]:
    """One footnote for each reason, naming the methods it applies to unless that is all of them."""
    methods_by_note: dict[str, list[str]] = {}
    for name, result in results.items():
        for metric in METRICS:
            if metric.name in result.notes:
                note = f"{metric.title} {MISSING}: {result.notes[metric.name]}"
                methods_by_note.setdefault(note, []).append(name)
    return tuple(
        note if len(methods) == len(results) else f"{', '.join(methods)}: {note}"
        for note, methods in methods_by_note.items()
    )


def _heading(column: Column) -> str:
    return column.title + {"higher": " ↑", "lower": " ↓", None: ""}[column.better]


def _cell(value: Score, column: Column) -> str:
    return MISSING if value is None else f"{value:.{column.decimals}f}"


def _latex_row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _latex(text: str) -> str:
    special = {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        **{character: "\\" + character for character in "&%$#_{}"},
    }
    return "".join(special.get(character, character) for character in text)
