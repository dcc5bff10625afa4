"""Count the code lines of the project: `python tests/size.py`.

A code line holds at least one token that is neither a comment nor part of a docstring. Blank lines count only inside
strings, because they are data there.
"""

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("nerfro", "tests", "benchmarks", "plugins")
_LAYOUT = {getattr(tokenize, name) for name in ("COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER")}


def count_code_lines(source: str) -> int:
    """Count the lines of Python source that are neither blank, nor comment, nor docstring."""
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _LAYOUT:
            code.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if documented and ast.get_docstring(node) is not None:
            docstring = node.body[0]
            code.difference_update(range(docstring.lineno, docstring.end_lineno + 1))
    return len(code)


def count_by_component(folder: Path) -> Counter[str]:
    """Count the code lines of each subfolder; modules directly in the folder are one component."""
    lines: Counter[str] = Counter()
    for file in sorted(folder.rglob("*.py")):
        parts = file.relative_to(folder).parts
        lines[parts[0] if len(parts) > 1 else "(top level)"] += count_code_lines(file.read_text(encoding="utf-8"))
    return lines


def main() -> None:
    """Print one table: a row for each component and a total for each folder."""
    totals = {}
    for folder in FOLDERS:
        lines = count_by_component(ROOT / folder)
        totals[folder] = lines.total()
        for component, number in sorted(lines.items()):
            print(f"{folder + '/' + component:<28}{number:>8,}")
        print(f"{folder + ' total':<28}{lines.total():>8,}\n")
    print(f"{'product (nerfro, plugins)':<28}{totals['nerfro'] + totals['plugins']:>8,}")


if __name__ == "__main__":
    main()
