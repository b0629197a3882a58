"""The command line: one subcommand per verb, a thin layer over the functions of the same names."""

from keyss.cli.entry import main

__all__ = ["main"]
