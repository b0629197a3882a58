"""Misspelt commands and options."""

from __future__ import annotations

import re

import pytest

from cli.said import COMMANDS, Run, assert_refused
from keyss.cli import commands, entry


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("revael", "x"), "did you mean `keyss reveal`?"),
        (("Hide",), "did you mean `keyss hide`?"),
        (("--quiet", "inof", "x"), "did you mean `keyss info`?"),
        (("frobnicate",), "see `keyss --help`"),
        (("convert", "a.ply", "-o", "b.spz"), "name OUT after IN"),
        (("audit", "run", "-o", "x"), "results go into the folder of the run"),
    ],
)
def test_a_misspelt_command(keyss: Run, arguments: tuple[str, ...], meant: str) -> None:
    assert_refused(keyss(*arguments), 2, meant)


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("reveal", "a", "--keyfile", "k", "-o", "b"), "--key-file FILE"),
        (("hide", "--cover", "a", "--seckret=b", "-o", "c"), "--secret SCENE"),
        (("hide", "--method", "carry", "--prune-to-fitt", "-o", "c"), "--prune-to-fit"),
    ],
)
def test_a_misspelt_option(keyss: Run, arguments: tuple[str, ...], meant: str) -> None:
    said = keyss(*arguments)
    assert (said.status, said.out) == (2, "")
    assert meant in said.err.partition("Perhaps you meant")[2]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_of_the_help_is_known(keyss: Run, command: str) -> None:
    """The help comes from the parser; messages take the options of a command from its signature."""
    known = {f"--{name.replace('_', '-')}" for name in entry.options_of(commands.parse_target(command, []))}
    lines = (line.strip("│ ") for line in keyss(command, "--help").out.splitlines())
    named = (line.partition("  ")[0] for line in lines if line.startswith("-"))
    offered = {flag for line in named for flag in re.findall(r"--[a-z][a-z-]*", line)}
    assert offered - {"--help"} == known
