"""Tables of scores: contents, and output as console text, CSV, Markdown, LaTeX and HTML."""

from __future__ import annotations

import csv
import html
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

from nerfro.errors import NerfroError
from nerfro.evaluation.image_metrics import image_metrics
from nerfro.evaluation.results import (
    AS_GIVEN,
    FULL,
    EvaluationResult,
    Region,
    RunMetrics,
    Score,
    write_metrics_json,
)
from nerfro.files.atomic import write_atomically

MISSING = "n/a"
MEDALS = ("gold", "silver", "bronze")

# Format of a cell for each mark. The LaTeX colours are pale, so that black numbers stay readable on these.
_LATEX = {"": "%s", "best": r"\textbf{%s}"}
_LATEX |= {
    medal: rf"\cellcolor[HTML]{{{colour}}}%s"
    for medal, colour in zip(MEDALS, ("F7DC8A", "DADDE2", "EBC3A0"), strict=True)
}
_MARKDOWN = {"": "%s", "best": "**%s**", "gold": "%s 🥇", "silver": "%s 🥈", "bronze": "%s 🥉"}
_HTML = {"": "<td>%s</td>", "best": "<td><strong>%s</strong></td>"}
_HTML |= {medal: f'<td class="{medal}">%s<span class="unseen"> {medal}</span></td>' for medal in MEDALS}


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


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes:
        label: heading of the row.
        values: one number per column, or None for a missing number.
        spreads: standard deviation of each number, or None; empty if no number has one.
        block: heading of this row and its neighbours of the same block. Marks compare the rows of a block.
    """

    label: str
    values: tuple[Score, ...]
    spreads: tuple[Score, ...] = ()
    block: str = ""

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
        summary: rows below a rule, such as means. These are neither ranked nor marked.
        mark: whether to mark nothing, the `best` value of each column, or the best three with `medals`.
        notes: footnotes, such as the reason for a missing number.
    """

    title: str
    label_title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    summary: tuple[Row, ...] = ()
    mark: Literal["", "best", "medals"] = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for row in (*self.rows, *self.summary):
            for numbers in (row.values, row.spreads or row.values):
                if len(numbers) != len(self.columns):
                    raise NerfroError(
                        f"table {self.title!r}: {len(numbers)} values of {row.label!r} for {len(self.columns)} columns"
                    )

    def mark_of(self, row: int, column: int) -> str:
        """Return the mark of a number in `rows`: "best", one of `MEDALS`, or an empty string.

        Numbers that are printed alike have the same rank, because readers cannot distinguish them. The number after two
        equal best ones is second, as in the table of the paper.
        """
        better, decimals = self.columns[column].better, self.columns[column].decimals
        value = self.rows[row].values[column]
        if not self.mark or better is None or value is None:
            return ""
        values = [other.values[column] for other in self.rows if other.block == self.rows[row].block]
        distinct = {round(other, decimals) for other in values if other is not None}
        rank = sorted(distinct, reverse=better == "higher").index(round(value, decimals))
        marks = MEDALS if self.mark == "medals" else ("best",)
        return marks[rank] if rank < len(marks) else ""

    def cells(self, row: Row) -> list[str]:
        """Return the numbers of a row as printed."""
        return [_cell(value, row.spread(j), self.columns[j].decimals) for j, value in enumerate(row.values)]

    def marked_cells(self, row: int, forms: Mapping[str, str]) -> list[str]:
        """Return the cells of one of `rows`, formatted by mark; `forms` maps each mark to a format with `%s`."""
        return [forms[self.mark_of(row, j)] % cell for j, cell in enumerate(self.cells(self.rows[row]))]

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
    notes = [_mask_note(result) if region != FULL else "", _missing_note(result, region)]
    return _scores_table(title, "view", scores, notes, {"mean": result.means(region)})


def regions_table(result: EvaluationResult, title: str) -> Table:
    """Tabulate the mean scores of each region, with notes about missing scores."""
    scores = {str(region): result.means(region) for region in result.regions}
    regions: dict[str, list[str]] = {}
    for region in result.regions:
        regions.setdefault(_missing_note(result, region), []).append(region)
    notes = [f"{', '.join(names)}: {note}" for note, names in regions.items() if note]
    return _scores_table(title, "region", scores, [_mask_note(result), *notes])


def treatments_table(metrics: RunMetrics, title: str) -> Table:
    """Tabulate the mean scores of the test views under each treatment (see `nerfro.evaluation.treatments`)."""
    treated = {name: result.means() for name, result in metrics.treatments.items()}
    return _scores_table(title, "test views", {AS_GIVEN: metrics.result.means()} | treated, [])


def short(reason: str) -> str:
    """Return a reason without the advice after its semicolon."""
    return reason.partition(";")[0]


def report(metrics: RunMetrics, title: str, folder: Path, brief: bool = False) -> None:
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
    if brief or len(result.regions) > 1:
        rich.print(to_rich(regions_table(result, f"mean of {len(result.views)} views")))
    if metrics.treatments:
        rich.print(to_rich(treatments_table(metrics, "means of the full images, or of right halves")))


def write_table(table: Table, stem: Path | str) -> list[Path]:
    """Write `<stem>.csv`, `<stem>.md` and `<stem>.tex`, and return the three paths."""
    texts = {f"{stem}.csv": to_csv(table), f"{stem}.md": to_markdown(table), f"{stem}.tex": to_latex(table)}
    for path, text in texts.items():
        write_atomically(path, text)
    return list(map(Path, texts))


def to_rich(table: Table) -> rich.console.Group:
    """Format a table for the console: `rich.print(to_rich(table))`.

    If the console is too narrow for all groups of columns, the groups are stacked.
    """
    # A caption would be wrapped to the width of the table, so footnotes are separate texts.
    return rich.console.Group(_Drawn(table), *(rich.text.Text(note, style="dim") for note in table.notes))


@dataclass(frozen=True)
class _Drawn:
    """Renderable table that splits into blocks of whole column groups to fit the width of the console."""

    table: Table

    def __rich_console__(
        self, console: rich.console.Console, options: rich.console.ConsoleOptions
    ) -> Iterator[rich.table.Table]:
        unbounded = options.update(max_width=10_000)
        start = stop = 0
        for _, num_columns in self.table.groups():
            wider = self._block(start, stop + num_columns)
            if stop > start and console.measure(wider, options=unbounded).maximum > options.max_width:
                yield self._block(start, stop)
                start = stop
            stop += num_columns
        yield self._block(start, stop)

    def _block(self, start: int, stop: int) -> rich.table.Table:
        table, columns = self.table, range(start, stop)
        grouped = any(column.group for column in table.columns)
        title = rich.text.Text(table.title) if start == 0 else None
        drawn = rich.table.Table(title=title, box=rich.box.SIMPLE_HEAD)
        drawn.add_column(rich.text.Text(table.label_title), vertical="bottom", overflow="fold")
        for j in columns:
            column = table.columns[j]
            above = column.group if j == start or column.group != table.columns[j - 1].group else ""
            heading = f"{above}\n{_heading(column)}" if grouped else _heading(column)
            drawn.add_column(rich.text.Text(heading), justify="right", no_wrap=True)
        for i, row in enumerate(table.rows):
            cells = [self._text(i, j) for j in columns]
            drawn.add_row(rich.text.Text(row.label), *cells, end_section=i == len(table.rows) - 1)
        for row in table.summary:
            drawn.add_row(*map(rich.text.Text, (row.label, *table.cells(row)[start:stop])), style="bold")
        return drawn

    def _text(self, i: int, j: int) -> rich.text.Text:
        cell, mark = self.table.cells(self.table.rows[i])[j], self.table.mark_of(i, j)
        if self.table.mark != "medals":
            return rich.text.Text(cell, style="bold" if mark else "")
        return rich.text.Text(_MARKDOWN[mark] % cell if mark else f"{cell}   ")  # a medal is two cells wide


def to_csv(table: Table) -> str:
    """Format a table as CSV with all digits and without marks. Footnotes are the last lines and begin with `#`.

    If a row has standard deviations, each column is followed by a column `<title> std`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rows = (*table.rows, *table.summary)
    spread = any(row.spreads for row in rows)
    headings = [f"{column.group} {column.title}".strip() for column in table.columns]
    writer.writerow(
        [table.label_title, *(h for name in headings for h in ((name, f"{name} std") if spread else (name,)))]
    )
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

    headings = [f"{column.group} {_heading(column)}".strip() for column in table.columns]
    lines = [f"**{table.title}**", "", line([table.label_title, *headings])]
    lines.append("|" + "|".join([":---", *("---:" for _ in table.columns)]) + "|")
    for i, row in enumerate(table.rows):
        lines.append(line([row.label, *table.marked_cells(i, _MARKDOWN)]))
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
        cells = [cell.replace("±", r"$\pm$") for cell in table.marked_cells(i, _LATEX)]
        lines.append(_latex_row([_latex(row.label), *cells]))
    if table.summary:
        lines.append(r"\midrule")
    for row in table.summary:
        lines.append(_latex_row([_latex(row.label), *map(_latex, table.cells(row))]))
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += [rf"\par\smallskip{{\footnotesize {_latex(note)}}}" for note in table.notes]
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def to_html(table: Table) -> str:
    """Format a table as an HTML `<table>`, with footnotes as paragraphs of class `note`.

    Best values are `<strong>`. Cells with medals have the name of the medal as class, and as text of class `unseen`.
    """
    grouped = any(column.group for column in table.columns)
    lines = ["<table>", f"<caption>{html.escape(table.title)}</caption>", "<thead>", "<tr>"]
    rows = 2 if grouped else 1
    lines.append(f'<th scope="col" rowspan="{rows}">{html.escape(table.label_title)}</th>')
    if grouped:
        lines += [f'<th scope="colgroup" colspan="{n}">{html.escape(name)}</th>' for name, n in table.groups()]
        lines.append("</tr><tr>")
    lines += [f'<th scope="col">{html.escape(_heading(column))}</th>' for column in table.columns]
    lines += ["</tr>", "</thead>", "<tbody>"]
    for i, row in enumerate(table.rows):
        if row.block and (i == 0 or row.block != table.rows[i - 1].block):
            heading = f'<th class="block" scope="rowgroup" colspan="{len(table.columns) + 1}">'
            lines.append(f"<tr>{heading}{html.escape(row.block)}</th></tr>")
        cells = "".join(table.marked_cells(i, _HTML))
        lines.append(f'<tr><th scope="row">{html.escape(row.label)}</th>{cells}</tr>')
    lines.append("</tbody>")
    if table.summary:
        lines.append("<tfoot>")
        for row in table.summary:
            cells = "".join(f"<td>{html.escape(text)}</td>" for text in table.cells(row))
            lines.append(f'<tr><th scope="row">{html.escape(row.label)}</th>{cells}</tr>')
        lines.append("</tfoot>")
    lines.append("</table>")
    return "\n".join([*lines, *(f'<p class="note">{html.escape(note)}</p>' for note in table.notes)]) + "\n"


def _heading(column: Column) -> str:
    return column.title + {"higher": " ↑", "lower": " ↓", None: ""}[column.better]


def _scores_table(
    title: str,
    label_title: str,
    rows: Mapping[str, Mapping[str, Score]],
    notes: Sequence[str],
    summary: Mapping[str, Mapping[str, Score]] | None = None,
) -> Table:
    """Tabulate scores by row label and metric, without empty columns."""
    known = image_metrics()
    columns = tuple(Column(metric.title, metric.better, metric.decimals) for metric in known.values())
    body, foot = (
        tuple(Row(label, tuple(scores[name] for name in known)) for label, scores in part.items())
        for part in (rows, summary or {})
    )
    table = Table(title, label_title, columns, body, foot, notes=tuple(note for note in notes if note))
    return table.without_empty_columns()


def _mask_note(result: EvaluationResult) -> str:
    return f"Mask and crop {MISSING}: {result.notes['mask']}" if "mask" in result.notes else ""


def _missing_note(result: EvaluationResult, region: Region) -> str:
    """Name the metrics that are missing in a region, with the reasons, in one line."""
    by_reason: dict[str, list[str]] = {}
    for name, metric in image_metrics().items():
        reason = result.notes.get(name if region == FULL else f"{region}.{name}")
        if reason is not None:
            by_reason.setdefault(short(reason), []).append(metric.title)
    missing = ", ".join(f"{', '.join(titles)} ({reason})" for reason, titles in by_reason.items())
    return f"{MISSING}: {missing}" if missing else ""


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
