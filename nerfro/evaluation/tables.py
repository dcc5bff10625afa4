"""Tables of scores in memory, and their forms on paper: console, CSV, Markdown, LaTeX and HTML."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Literal

import rich.box
import rich.console
import rich.table
import rich.text

from nerfro.errors import NerfroError
from nerfro.evaluation.results import Score
from nerfro.files.atomic import write_atomically

MISSING = "n/a"
MEDALS = ("gold", "silver", "bronze")
_MEDAL_SIGNS = {"gold": "🥇", "silver": "🥈", "bronze": "🥉"}
_MEDAL_COLOURS = {"gold": "F7DC8A", "silver": "DADDE2", "bronze": "EBC3A0"}  # pale: black figures are read on them


@dataclass(frozen=True)
class Column:
    """One column of numbers."""

    title: str  # heading
    better: Literal["higher", "lower"] | None = None  # which values are better; None if the column is not a competition
    decimals: int = 2  # digits after the point, in all forms but CSV, which keeps every digit
    group: str = ""  # heading above this column and those beside it of the same group; empty for none


@dataclass(frozen=True)
class Row:
    """One line of a table: what it is about, and a number for each column; None where there is none."""

    label: str  # what the line is about
    values: tuple[Score, ...]  # the numbers
    spreads: tuple[Score, ...] = ()  # standard deviation of each number, None where there is none; empty without any

    def spread(self, column: int) -> Score:
        return self.spreads[column] if self.spreads else None


@dataclass(frozen=True)
class Table:
    """A table of numbers."""

    title: str  # what it shows
    label_title: str  # heading of the rows' labels
    columns: tuple[Column, ...]  # headings and meaning of the numbers
    rows: tuple[Row, ...]  # the lines, in order
    summary: tuple[Row, ...] = ()  # lines below a rule, such as means
    mark_best: bool = False  # whether the best values of each column among `rows` are emphasised
    medals: bool = False  # whether the best three are marked gold, silver and bronze instead
    notes: tuple[str, ...] = ()  # footnotes, such as the reason for a missing number

    def __post_init__(self) -> None:
        for row in (*self.rows, *self.summary):
            for numbers in (row.values, row.spreads or row.values):
                if len(numbers) != len(self.columns):
                    raise NerfroError(
                        f"table {self.title!r}: {len(numbers)} values of {row.label!r} for {len(self.columns)} columns"
                    )

    def is_best(self, row: int, column: int) -> bool:
        """Whether a value of `rows` is emphasised as the best of its column, or equal to it as printed."""
        return self.mark_best and self._place(row, column) == 0

    def medal(self, row: int, column: int) -> str | None:
        """Which of `MEDALS` a value of `rows` wins, if any."""
        place = self._place(row, column) if self.medals else None
        return None if place is None or place >= len(MEDALS) else MEDALS[place]

    def groups(self) -> list[tuple[str, int]]:
        """Group headings, and over how many columns each stands."""
        return [(group, len(list(columns))) for group, columns in groupby(column.group for column in self.columns)]

    def _place(self, row: int, column: int) -> int | None:
        """How many different values of a column are better than one of `rows`; None where there is no competition.

        Values that print alike are placed alike: a reader cannot see a difference between them. The value after two
        equal best ones is second, as in the paper's table.
        """
        better, decimals = self.columns[column].better, self.columns[column].decimals
        value = self.rows[row].values[column]
        if better is None or value is None:
            return None
        present = [other.values[column] for other in self.rows]
        rivals = {round(other, decimals) for other in present if other is not None}
        return sorted(rivals, reverse=better == "higher").index(round(value, decimals))


def to_rich(table: Table) -> rich.console.Group:
    """Lay a table out for the console, `rich.print(to_rich(table))`; best values bold or with medals, footnotes below.

    Where the console is too narrow for all groups of columns, they are stacked.
    """
    # Footnotes are no caption of the drawn table: that would be wrapped to the table's width.
    return rich.console.Group(_Drawn(table), *(rich.text.Text(note, style="dim") for note in table.notes))


@dataclass(frozen=True)
class _Drawn:
    """A table for rich, in as many blocks of whole groups of columns as the console's width asks for."""

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
        drawn.add_column(rich.text.Text(table.label_title), vertical="bottom")
        for j in columns:
            column = table.columns[j]
            above = column.group if j == start or column.group != table.columns[j - 1].group else ""
            heading = f"{above}\n{_heading(column)}" if grouped else _heading(column)
            drawn.add_column(rich.text.Text(heading), justify="right", no_wrap=True)
        for i, row in enumerate(table.rows):
            cells = [rich.text.Text(self._text(i, j), style="bold" if table.is_best(i, j) else "") for j in columns]
            drawn.add_row(rich.text.Text(row.label), *cells, end_section=i == len(table.rows) - 1)
        for row in table.summary:
            texts = _cells(row, table)[start:stop]
            drawn.add_row(rich.text.Text(row.label), *map(rich.text.Text, texts), style="bold")
        return drawn

    def _text(self, i: int, j: int) -> str:
        cell, medal = _cells(self.table.rows[i], self.table)[j], self.table.medal(i, j)
        if not self.table.medals:
            return cell
        return f"{cell} {_MEDAL_SIGNS[medal]}" if medal else f"{cell}   "  # a medal is two cells wide


def to_csv(table: Table) -> str:
    """Write a table as CSV: every digit, no marks; footnotes as last lines that begin with `#`.

    If a row has spreads, each column is followed by one of them, its heading with `std`.
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
    """Write a table as GitHub-flavoured Markdown: best values bold or with medals, summary rows in italics."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    def marked(i: int, j: int, cell: str) -> str:
        medal = table.medal(i, j)
        return f"**{cell}**" if table.is_best(i, j) else f"{cell} {_MEDAL_SIGNS[medal]}" if medal else cell

    headings = [f"{column.group} {_heading(column)}".strip() for column in table.columns]
    lines = [f"**{table.title}**", "", line([table.label_title, *headings])]
    lines.append("|" + "|".join([":---", *("---:" for _ in table.columns)]) + "|")
    for i, row in enumerate(table.rows):
        lines.append(line([row.label, *(marked(i, j, cell) for j, cell in enumerate(_cells(row, table)))]))
    for row in table.summary:
        lines.append(line([f"*{row.label}*", *(f"*{cell}*" for cell in _cells(row, table))]))
    lines += [text for note in table.notes for text in ("", note)]
    return "\n".join(lines) + "\n"


def to_latex(table: Table) -> str:
    r"""Write a table as LaTeX; the document needs `\usepackage{booktabs}`, and for medals `\usepackage[table]{xcolor}`.

    Best values are bold or coloured by their medals, summary rows stand below a rule, footnotes below the table.
    """

    def marked(i: int, j: int, cell: str) -> str:
        medal = table.medal(i, j)
        if medal:
            return rf"\cellcolor[HTML]{{{_MEDAL_COLOURS[medal]}}}{cell}"
        return rf"\textbf{{{cell}}}" if table.is_best(i, j) else cell

    def cells(row: Row) -> list[str]:
        return [_latex(cell) for cell in _cells(row, table)]

    arrows = {"higher": r" $\uparrow$", "lower": r" $\downarrow$", None: ""}
    headings = [_latex(table.label_title), *(_latex(c.title) + arrows[c.better] for c in table.columns)]
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{_latex(table.title)}}}"]
    lines += [rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}", r"\toprule"]
    if any(column.group for column in table.columns):
        lines += _latex_groups(table)
    lines += [_latex_row(headings), r"\midrule"]
    for i, row in enumerate(table.rows):
        lines.append(_latex_row([_latex(row.label), *(marked(i, j, cell) for j, cell in enumerate(cells(row)))]))
    if table.summary:
        lines.append(r"\midrule")
    for row in table.summary:
        lines.append(_latex_row([_latex(row.label), *cells(row)]))
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += [rf"\par\smallskip{{\footnotesize {_latex(note)}}}" for note in table.notes]
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def to_html(table: Table) -> str:
    """Write a table as an HTML `<table>`; footnotes follow as paragraphs of class `note`.

    Best values are `<strong>`; cells with medals have their names as class, and as text of class `unseen`.
    """

    def cell(i: int, j: int, text: str) -> str:
        medal, text = table.medal(i, j), html.escape(text)
        if medal:
            return f'<td class="{medal}">{text}<span class="unseen"> {medal}</span></td>'
        return f"<td><strong>{text}</strong></td>" if table.is_best(i, j) else f"<td>{text}</td>"

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
        cells = "".join(cell(i, j, text) for j, text in enumerate(_cells(row, table)))
        lines.append(f'<tr><th scope="row">{html.escape(row.label)}</th>{cells}</tr>')
    lines.append("</tbody>")
    if table.summary:
        lines.append("<tfoot>")
        for row in table.summary:
            cells = "".join(f"<td>{html.escape(text)}</td>" for text in _cells(row, table))
            lines.append(f'<tr><th scope="row">{html.escape(row.label)}</th>{cells}</tr>')
        lines.append("</tfoot>")
    lines.append("</table>")
    return "\n".join([*lines, *(f'<p class="note">{html.escape(note)}</p>' for note in table.notes)]) + "\n"


def write_table(table: Table, stem: Path | str) -> list[Path]:
    """Write `<stem>.csv`, `<stem>.md` and `<stem>.tex`, and return the three paths."""
    stem = Path(stem)
    texts = {".csv": to_csv(table), ".md": to_markdown(table), ".tex": to_latex(table)}
    paths = [stem.with_name(stem.name + suffix) for suffix in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        write_atomically(path, text)
    return paths


def _heading(column: Column) -> str:
    return column.title + {"higher": " ↑", "lower": " ↓", None: ""}[column.better]


def _cells(row: Row, table: Table) -> list[str]:
    """The numbers of a row as they are printed."""
    return [_cell(value, row.spread(j), table.columns[j].decimals) for j, value in enumerate(row.values)]


def _cell(value: Score, spread: Score, decimals: int) -> str:
    if value is None:
        return MISSING
    return f"{value:.{decimals}f}" + ("" if spread is None else f" ± {spread:.{decimals}f}")


def _latex_groups(table: Table) -> list[str]:
    """The row of group headings, and the rules below them."""
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
