"""Completion of commands and options in bash, zsh and fish: `nerfro --completion SHELL` prints the code for a shell."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence

from nerfro.cli.options import Described, recall
from nerfro.core.errors import NerfroError

# Where no option is found, the shells complete the names of files and folders.
_CODE = {
    "bash": "complete -o nospace -o default -C 'nerfro --complete' nerfro",
    "zsh": """_nerfro() {
    local -a found=("${(@f)$(COMP_LINE=$LBUFFER nerfro --complete)}")
    if [[ -n $found ]]; then compadd -Q -S '' -- $found; else compset -P '*='; _files; fi
}
compdef _nerfro nerfro""",
    "fish": """function __nerfro
    set -l found (env COMP_LINE=(commandline -cp | string collect) nerfro --complete | string trim)
    if test -n "$found[1]"
        printf '%s\\n' $found
    else if set -l parts (string split -m 1 = (commandline -ct))
        printf '%s\\n' $parts[1]=(__fish_complete_path $parts[2])
    end
end
complete -c nerfro -f -a '(__nerfro)'""",
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

    Options are known once the command, or its `--help`, has run.

    Args:
        commands: names of the commands.
        arguments: in bash and zsh, the program, the word that is replaced, and the word before it. The word is the
            part after an equals sign, if there is one.
    """
    line = os.environ.get("COMP_LINE", "").encode()[: int(os.environ.get("COMP_POINT", "-1")) % 2**31].decode()
    _, *words, last = f"{line} ".removesuffix(" ").split(" ")
    described = recall(words[0]) if words else None
    words_known = (
        (f"{command} " for command in commands) if not words else () if described is None else _options(described)
    )
    kept = len(last) - len(arguments[1]) if len(arguments) > 1 else 0
    plus = last[: len(last) - len(last.lstrip("+"))]  # Hydra's sign of an added option
    completions = (plus + text for text in words_known)
    return sorted(text[kept:] for text in completions if text.startswith(last) and "." not in text[len(last) : -1])


def _options(described: Described) -> Iterator[str]:
    for group, names in described.choices.items():
        yield from (f"{group}={name} " for name in names)
    for node, names in described.names.items():
        for name in () if "=" in node else names:  # those of each plugin are among those of the node
            full_name = f"{node}.{name}".removeprefix(".")
            if full_name not in described.choices and name != "_target_":
                yield full_name + ("." if full_name in described.names else "=")
