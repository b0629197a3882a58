"""The command line: one subcommand per verb, a thin layer over the functions of the same names."""

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """See `keyss.cli.entry.main`, which is imported late: handlers of Ctrl-C have to be installed first."""
    from keyss.cli.entry import main

    return main(arguments)
