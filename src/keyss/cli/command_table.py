"""The commands, in the groups of `keyss --help`, and the module of each.

A module is imported when its command runs, and imports heavy packages inside the command, which keeps
`keyss --help` fast.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence

GROUPS = {
    "make": {
        "demo": "cli.make",
        "fit": "cli.make",
        "hide": "cli.hide_command",
        "keygen": "cli.make",
        "convert": "cli.make",
    },
    "open": {"reveal": "cli.open_and_show", "verify": "cli.open_and_show"},
    "look": {"view": "cli.open_and_show", "render": "cli.open_and_show", "info": "cli.open_and_show"},
    "measure": {"evaluate": "cli.open_and_show", "audit": "lab.lab_commands"},
    "many": dict.fromkeys(("compare", "reproduce", "sweep"), "lab.lab_commands"),
    "check": {"doctor": "cli.doctor"},
}
MODULES = {name: module for group in GROUPS.values() for name, module in group.items()}

_PAGE = """usage: keyss COMMAND [OPTIONS]

Hide a 3D Gaussian Splatting scene inside another one and open it only with a key.
{commands}

`keyss COMMAND --help` shows the options of a command and examples.

  -q, --quiet              print nothing but paths of results, and errors
  -v, --verbose            show more progress, and the time at the end
  -V, --version            print the version
  --completion {{bash,zsh}}  print a completion script for the shell

A key is read from --key-file, from the environment variable KEYSS_KEY, or from a prompt.
Exit status: 0 done, 2 wrong usage, 3 wrong key, 4 unreadable input, 5 unwritable output,
6 missing backend, 7 failed quality check, 8 out of memory, 70 internal error,
130 interrupted, 141 broken pipe, 143 terminated."""


def command(name: str) -> Callable[..., None]:
    """The function of a command."""
    function: Callable[..., None] = getattr(importlib.import_module(f"keyss.{MODULES[name]}"), name)
    return function


def parse_target(name: str, arguments: Sequence[str]) -> Callable[..., None]:
    """The function to parse: for `hide`, with the options of the method named in `arguments`."""
    if name == "hide":
        from keyss.cli.hide_command import with_options_of_method

        return with_options_of_method(arguments)
    return command(name)


def help_page() -> str:
    """The text of `keyss --help`: a line for each command."""
    lines = []
    for group, names in GROUPS.items():
        lines += ["", f"{group}:"]
        for name in names:
            summary = (command(name).__doc__ or "").partition("\n")[0]
            lines.append(f"  {name:<12} {summary}")
    return _PAGE.format(commands="\n".join(lines))
