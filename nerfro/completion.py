"""Completion of commands and options in bash, zsh and fish: `nerfro --completion SHELL` prints the code for a shell."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence

from nerfro.errors import NerfroError
from nerfro.options import Described, recall

_BASH = "complete -o nospace -C 'nerfro --complete' nerfro"
_CODE = {
    "bash": _BASH,
    "zsh": f"autoload -U +X bashcompinit && bashcompinit\n{_BASH}",
    "fish": "complete -c nerfro -f -a "
    "'(env COMP_LINE=(commandline -cp | string collect) nerfro --complete | string trim)'",
}


def shell_code(shell: str) -> str:
    """Return the code that enables completion, for the start-up file of a shell.

    Raises:
        NerfroError: the shell is unknown.
    """
    if shell not in _CODE:
        raise NerfroError(f"--completion {shell} is not a shell that is supported; choose one of {', '.join(_CODE)}")
    return _CODE[shell]


def completions(commands: Iterable[str], arguments: Sequence[str]) -> list[str]:
    """Return the completions of the line that a shell passes in COMP_LINE, up to the cursor at COMP_POINT.

    Options are known once the command has run.

    Args:
        commands: names of the commands.
        arguments: in bash and zsh, the program, the word that is replaced, and the word before it. The word is the
            part after an equals sign, if there is one.
    """
    line = os.environ.get("COMP_LINE", "").encode()[: int(os.environ.get("COMP_POINT", "-1")) % 2**31].decode()
    _, *words, last = f"{line} ".removesuffix(" ").split(" ")
    described = recall(words[0]) if words else None
    known = (f"{command} " for command in commands) if not words else () if described is None else _options(described)
    kept = len(last) - len(arguments[1]) if len(arguments) > 1 else 0
    found = (text for text in known if text.startswith(last) and "." not in text[len(last) : -1])
    return sorted(text[kept:] for text in found)


def _options(described: Described) -> Iterator[str]:
    for group, names in described.choices.items():
        yield from (f"{group}={name} " for name in names)
    for node, names in described.names.items():
        for name in names:
            place = f"{node}.{name}".removeprefix(".")
            if place not in described.choices and name != "_target_":
                yield place + ("." if place in described.names else "=")
