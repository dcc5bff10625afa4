"""`python -m nerfro`, or `nerfro` after installation: list the commands, or run one, such as `nerfro train seed=1`."""

from __future__ import annotations

import ast
import runpy
import sys

from nerfro.cli.completion import completions, shell_code
from nerfro.cli.entry import print_version
from nerfro.cli.failures import errors_in_one_line
from nerfro.core.errors import NerfroError, nearest_of
from nerfro.core.paths import PACKAGE_DIR


def main() -> None:
    """List the commands, or run the command in the first argument."""
    with errors_in_one_line():
        names = commands()
        name, *arguments = sys.argv[1:] or ["--help"]
        if name in ("-h", "--help"):
            print("nerfro COMMAND [key=value ...], or python -m nerfro.COMMAND [key=value ...]\n")
            for command, purpose in names.items():
                print(f"  {command:12}{purpose}")
            print("\nnerfro COMMAND --help lists the options of a command.")
        elif name == "--version":
            print_version()
        elif name == "--completion":
            print(shell_code(" ".join(arguments)))
        elif name == "--complete":
            print("\n".join(completions(names, arguments)))
        elif name not in names:
            raise NerfroError(f"there is no command '{name}'; {nearest_of(name, list(names))}")
    if name not in names:
        return
    del sys.argv[1]
    # Like python -m, because Hydra, launchers and the record of a run read the command from `__main__`.
    runpy.run_module(f"nerfro.{name}", run_name="__main__", alter_sys=True)


def commands() -> dict[str, str]:
    """Find the commands and their descriptions, from modules whose docstring begins "`python -m nerfro.NAME ...`: "."""
    summaries = {}
    for file in sorted(PACKAGE_DIR.glob("*.py")):
        first = (ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "").partition("\n")[0]
        if first.startswith(f"`python -m nerfro.{file.stem}"):
            summaries[file.stem] = first.partition("`: ")[2]
    return summaries


if __name__ == "__main__":
    main()
