"""Answer `--help` and refuse misspelt options before the imports of a command, which take seconds.

Each command imports this module first. If the command is the main program, importing the module has these effects:
`--version` and `--help` are answered, misspelt options are refused, as far as the cache of `nerfro.cli.options` knows
them, and Ctrl-C during the imports ends the program in one line.
"""

from __future__ import annotations

import sys
from types import TracebackType

from nerfro.cli.entry import print_version, program
from nerfro.cli.failures import errors_in_one_line
from nerfro.cli.options import Described, recall, usage

_WITHOUT_CONFIGURATION = ("check", "demo", "plugins")  # commands


def begin(command: str) -> None:
    """Handle the command line as far as possible without the plugins.

    Args:
        command: name of the command.
    """
    sys.excepthook = _print_in_one_line
    if "--version" in sys.argv[1:]:
        print_version()
        sys.exit()
    with errors_in_one_line():
        described = Described(usage(command), {}, {}) if command in _WITHOUT_CONFIGURATION else recall(command)
        if described is not None:
            described.answer(sys.argv[1:])


def _print_in_one_line(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        print("nerfro: interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


_program = program()
if _program is not None:
    begin(_program)
