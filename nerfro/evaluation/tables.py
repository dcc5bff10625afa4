"""Tables of scores: contents, and output as console text, CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Literal

import rich
import rich.box
import rich.console
import rich.table
import rich.text
from rich.cells import cell_len

from nerfro.evaluation.image_metrics import image_metrics
from nerfro.evaluation.results import FULL, OF_HALVES, EvaluationResult, Region, RunMetrics, Score, write_metrics_json
from nerfro.files.atomic import write_atomically

MISSING = "n/a"
MEDALS = ("gold", "silver", "bronze")

# Format of a cell for each medal. The LaTeX colours are pale, so that black numbers stay readable on these.
_LATEX = {
    "": "%s",
    "gold": r"\cellcolor[HTML]{F7DC8A}%s",
    "silver": r"\cellcolor[HTML]{DADDE2}%s",
    "bronze": r"\cellcolor[HTML]{EBC3A0}%s",
}
_MARKDOWN = {"": "%s", "gold": "%s 🥇", "silver": "%s 🥈", "bronze": "%s 🥉"}
_CONSOLE = _MARKDOWN | {"": "%s   "}  # aligned with medals, which are two cells wide


@dataclass(frozen=True)
class Column:
    """One column of numbers.

    Attributes:
        title: heading.
        better: whether higher or lower values are better, or None if the values are not ranked.
        decimals: number of decimals in all formats except CSV, which keeps all digits.
        group: heading above this column and its neighbours of the same group; may be empty.
    """

    title: str
    better: Literal["higher", "lower"] | None = None
    decimals: int = 2
    group: str = ""

    @property
    def heading(self) -> str:
        """Title with an arrow that shows whether higher or lower values are better."""
        return self.title + {"higher": " ↑", "lower": " ↓", None: ""}[self.better]


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes:
        label: heading of the row.
        values: one number per column, or None for a missing number.
        spreads: standard deviation of each number, or None; empty if no number has one.
    """

    label: str
    values: tuple[Score, ...]
    spreads: tuple[Score, ...] = ()

    def spread(self, column: int) -> Score:
        return self.spreads[column] if self.spreads else None


@dataclass(frozen=True)
class Table:
    """A table of numbers.

    Attributes:
        title: caption.
        label_title: heading of the row labels.
        columns: columns of numbers.
        rows: rows of numbers.
        summary: rows below a rule, such as means, which get no medals.
        medals: whether to mark the best three values of each column.
        notes: footnotes, such as the reason for a missing number.
    """

    title: str
    label_title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    summary: tuple[Row, ...] = ()
    medals: bool = False
    notes: tuple[str, ...] = ()

    def __getitem__(self, cell: tuple[str, str]) -> Score:
        """Return a number by the label of its row and the title of its column, as in `table["mean", "PSNR"]`."""
        label, title = cell
        row = next(row for row in (*self.summary, *self.rows) if row.label == label)
        return row.values[[column.title for column in self.columns].index(title)]

    def __str__(self) -> str:
        return to_markdown(self)

    _repr_markdown_ = __str__  # in notebooks

    def medal_of(self, row: int, column: int) -> str:
        """Return the medal of a number in `rows`, one of `MEDALS`, or an empty string.

        Numbers that are printed alike have the same rank, because readers cannot distinguish them. The number after two
        equal best ones is second, as in the table of the paper.
        """
        better, decimals = self.columns[column].better, self.columns[column].decimals
        value = self.rows[row].values[column]
        if not self.medals or better is None or value is None:
            return ""
        values = (other.values[column] for other in self.rows)
        distinct = {round(other, decimals) for other in values if other is not None}
        rank = sorted(distinct, reverse=better == "higher").index(round(value, decimals))
        return MEDALS[rank] if rank < len(MEDALS) else ""

    def cells(self, row: Row) -> list[str]:
        """Return the numbers of a row as printed."""
        return [_cell(value, row.spread(j), self.columns[j].decimals) for j, value in enumerate(row.values)]

    def cells_with_medals(self, row: int, forms: Mapping[str, str]) -> list[str]:
        """Return the cells of one of `rows`; `forms` maps each medal, and no medal, to a format with `%s`."""
        return [forms[self.medal_of(row, j)] % cell for j, cell in enumerate(self.cells(self.rows[row]))]

    def without_empty_columns(self) -> Table:
        """Omit columns without any number in `rows`, unless no column has one."""
        kept = [j for j in range(len(self.columns)) if any(row.values[j] is not None for row in self.rows)]
        if not kept:
            return self

        def cut(row: Row) -> Row:
            spreads = tuple(row.spreads[j] for j in kept) if row.spreads else ()
            return replace(row, values=tuple(row.values[j] for j in kept), spreads=spreads)

        columns, rows, summary = (self.columns[j] for j in kept), map(cut, self.rows), map(cut, self.summary)
        return replace(self, columns=tuple(columns), rows=tuple(rows), summary=tuple(summary))

    def groups(self) -> list[tuple[str, int]]:
        """Return the group headings and the number of columns of each group."""
        return [(group, len(list(columns))) for group, columns in groupby(column.group for column in self.columns)]


def views_table(result: EvaluationResult, title: str, region: Region = FULL) -> Table:
    """Tabulate the scores of each view in one region, with means, and notes about missing scores."""
    scores = {view.name: {name: view.score(name, region) for name in image_metrics()} for view in result.views}
    return _scores_table(title, "view", scores, _missing_notes(result, [region]), {"mean": result.means(region)})


def means_table(metrics: RunMetrics, title: str) -> Table:
    """Tabulate the mean scores of each region and of each treatment (see `nerfro.evaluation.scoring`), with notes."""
    result = metrics.result
    scores = {str(region): result.means(region) for region in result.regions}
    for name, treated in metrics.treatments.items():
        scores[f"{name}, right halves" if name in OF_HALVES else name] = treated.means()
    return _scores_table(title, "pixels", scores, _missing_notes(result, result.regions))


def short(reason: str) -> str:
    """Return a reason without the advice after its semicolon."""
    return reason.partition(";")[0]


def write_scores(metrics: RunMetrics, title: str, folder: Path, brief: bool = False) -> None:
    """Write metrics.json and the tables of all regions into a folder, and print the scores.

    Args:
        metrics: the scores.
        title: title of the tables.
        folder: folder for the files.
        brief: print only means, without a table of views.
    """
    result = metrics.result
    for region in result.regions:
        full = region == FULL
        table = views_table(result, title if full else f"{title}, {region}", region)
        write_table(table, folder / ("metrics" if full else f"metrics_{region}"))
    write_metrics_json(folder / "metrics.json", metrics)  # last, because sweeps take it as the end of the run
    if not brief:
        rich.print(to_rich(views_table(result, title)))
    if brief or len(result.regions) > 1 or metrics.treatments:
        heading = f"mean of {len(result.views)} view{'s' * (len(result.views) > 1)}"
        rich.print(to_rich(means_table(metrics, heading)))


def write_table(table: Table, stem: Path) -> None:
    """Write `<stem>.csv`, `<stem>.md` and `<stem>.tex`."""
    for suffix, form in FORMATS.items():
        write_atomically(f"{stem}{suffix}", form(table))


def to_rich(table: Table) -> rich.console.RenderableType:
    """Format a table for the console: `rich.print(to_rich(table))`.

    Groups of columns are separate tables, one below the other, so that a comparison of many scenes fits the console. A
    group that is wider than the console is divided, too.
    """
    return _OnConsole(table)


@dataclass(frozen=True)
class _OnConsole:
    """A table that is divided for the width of a console."""

    table: Table

    def __rich_console__(
        self, console: rich.console.Console, options: rich.console.ConsoleOptions
    ) -> Iterator[rich.console.RenderableType]:
        table = self.table
        # A title or caption of a rich table would be wrapped to the width of the table.
        yield rich.text.Text(table.title, style="italic")
        start = 0
        for group, num_columns in table.groups():
            for columns in _fitting(table, slice(start, start + num_columns), options.max_width):
                yield _rich_group(table, group, columns)
            start += num_columns
        yield from (rich.text.Text(note, style="dim") for note in table.notes)


def _fitting(table: Table, columns: slice, width: int) -> Iterator[slice]:
    """Divide columns into parts that fit a console beside the labels of the rows.

    Args:
        table: the table.
        columns: columns of a group.
        width: characters in a line. A table has one at its left edge, and three more than its content in each column.
    """
    headings = [column.heading for column in table.columns]
    widths = [max(map(cell_len, cells)) for cells in zip(headings, *_console_cells(table), strict=True)]
    labels = (table.label_title, *(row.label for row in (*table.rows, *table.summary)))
    widest = max(widths[columns], default=0)
    left = 4 + min(max(map(cell_len, labels)), max(width - 7 - widest, 1))
    first, used = columns.start, left
    for j in range(columns.start, columns.stop):
        if j > first and used + widths[j] + 3 > width:
            yield slice(first, j)
            first, used = j, left
        used += widths[j] + 3
    yield slice(first, columns.stop)


def _rich_group(table: Table, group: str, columns: slice) -> rich.table.Table:
    drawn = rich.table.Table(title=rich.text.Text(group) if group else None, box=rich.box.SIMPLE_HEAD)
    drawn.add_column(rich.text.Text(table.label_title), overflow="fold")
    for column in table.columns[columns]:
        drawn.add_column(rich.text.Text(column.heading), justify="right", no_wrap=True)
    rows, cells = (*table.rows, *table.summary), _console_cells(table)
    for number, (row, texts) in enumerate(zip(rows, cells, strict=True), start=1):
        style = None if number <= len(table.rows) else "bold"
        shown = map(rich.text.Text, (row.label, *texts[columns]))
        drawn.add_row(*shown, end_section=number == len(table.rows), style=style)
    return drawn


def _console_cells(table: Table) -> list[list[str]]:
    """Return the cells of the rows, followed by those of the summary."""
    rows = [table.cells_with_medals(i, _CONSOLE if table.medals else _MARKDOWN) for i in range(len(table.rows))]
    return [*rows, *(table.cells(row) for row in table.summary)]


def to_csv(table: Table) -> str:
    """Format a table as CSV with all digits and without marks. Footnotes are the last lines and begin with `#`.

    If a row has standard deviations, each column is followed by a column `<title> std`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rows = (*table.rows, *table.summary)
    spread = any(row.spreads for row in rows)
    headings = [f"{column.group} {column.title}".strip() for column in table.columns]
    if spread:
        headings = [text for heading in headings for text in (heading, f"{heading} std")]
    writer.writerow([table.label_title, *headings])
    for row in rows:
        cells = [
            MISSING if number is None else repr(number)
            for j, value in enumerate(row.values)
            for number in ((value, row.spread(j)) if spread else (value,))
        ]
        writer.writerow([row.label, *cells])
    return text.getvalue() + "".join(f"# {note}\n" for note in table.notes)


def to_markdown(table: Table) -> str:
    """Format a table as GitHub-flavoured Markdown, with summary rows in italics."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    headings = [f"{column.group} {column.heading}".strip() for column in table.columns]
    lines = [f"**{table.title}**", "", line([table.label_title, *headings])]
    lines.append("|" + "|".join([":---", *("---:" for _ in table.columns)]) + "|")
    for i, row in enumerate(table.rows):
        lines.append(line([row.label, *table.cells_with_medals(i, _MARKDOWN)]))
    for row in table.summary:
        lines.append(line([f"*{row.label}*", *(f"*{cell}*" for cell in table.cells(row))]))
    lines += [text for note in table.notes for text in ("", note)]
    return "\n".join(lines) + "\n"


def to_latex(table: Table) -> str:
    r"""Format a table as LaTeX, with summary rows below a rule and footnotes below the table.

    The document needs `\usepackage{booktabs}`, and for medals `\usepackage[table]{xcolor}`.
    """
    arrows = {"higher": r" $\uparrow$", "lower": r" $\downarrow$", None: ""}
    headings = [_latex(table.label_title), *(_latex(c.title) + arrows[c.better] for c in table.columns)]
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{_latex(table.title)}}}"]
    lines += [rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}", r"\toprule"]
    if any(column.group for column in table.columns):
        lines += _latex_groups(table)
    lines += [_latex_row(headings), r"\midrule"]
    for i, row in enumerate(table.rows):
        # The numbers and "n/a" contain no special character but the sign of a standard deviation.
        cells = [cell.replace("±", r"$\pm$") for cell in table.cells_with_medals(i, _LATEX)]
        lines.append(_latex_row([_latex(row.label), *cells]))
    if table.summary:
        lines.append(r"\midrule")
    for row in table.summary:
        lines.append(_latex_row([_latex(row.label), *map(_latex, table.cells(row))]))
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += [rf"\par\smallskip{{\footnotesize {_latex(note)}}}" for note in table.notes]
    return "\n".join([*lines, r"\end{table}"]) + "\n"


FORMATS = {".csv": to_csv, ".md": to_markdown, ".tex": to_latex}


def _scores_table(
    title: str,
    label_title: str,
    rows: Mapping[str, Mapping[str, Score]],
    notes: Sequence[str],
    summary: Mapping[str, Mapping[str, Score]] | None = None,
) -> Table:
    """Tabulate scores by row label and metric, without empty columns."""
    metrics = image_metrics()
    columns = tuple(Column(metric.title, metric.better, metric.decimals) for metric in metrics.values())
    body, foot = (
        tuple(Row(label, tuple(scores[name] for name in metrics)) for label, scores in part.items())
        for part in (rows, summary or {})
    )
    table = Table(title, label_title, columns, body, foot, notes=tuple(notes))
    return table.without_empty_columns()


def _missing_notes(result: EvaluationResult, regions: Sequence[Region]) -> list[str]:
    """Give the reasons for scores that are missing in any of the regions."""
    notes = []
    if "mask" in result.notes and list(regions) != [FULL]:
        notes.append(f"Mask and crop {MISSING}: {result.notes['mask']}")
    for name, metric in image_metrics().items():
        is_missing = any(result.mean(name, region) is None for region in regions)
        if is_missing and name in result.notes:
            notes.append(f"{metric.title} {MISSING}: {short(result.notes[name])}")
    return notes


def _cell(value: Score, spread: Score, decimals: int) -> str:
    if value is None:
        return MISSING
    return f"{value:.{decimals}f}" + ("" if spread is None else f" ± {spread:.{decimals}f}")


def _latex_groups(table: Table) -> list[str]:
    """Format the row of group headings and the rules below it."""
    headings, rules, first = [""], [], 2
    for name, count in table.groups():
        headings.append(rf"\multicolumn{{{count}}}{{c}}{{{_latex(name)}}}")
        rules.append(rf"\cmidrule(lr){{{first}-{first + count - 1}}}")
        first += count
    return [_latex_row(headings), " ".join(rules)]


def _latex_row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _latex(text: str) -> str:
    special = {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "±": r"$\pm$",
        **{character: "\\" + character for character in "&%$#_{}"},
    }
    return "".join(special.get(character, character) for character in text)
