"""Errors that a person can cause. Each carries an exit status of its own for the command line.

A message says what was expected, what came, and what to do. The command line prints it in one or
two lines and never shows a traceback for these.
"""


class KeyssError(Exception):
    """Base of every error that a person can cause."""

    exit_status = 1


class UsageError(KeyssError):
    """Arguments that contradict each other or are out of range."""

    exit_status = 2


class WrongKeyError(KeyssError):
    """The key opens nothing here."""

    exit_status = 3


class InputError(KeyssError):
    """A file or folder that cannot be read as what it should be."""

    exit_status = 4


class OutputError(KeyssError):
    """A result that cannot be written (it exists, the disk is full, no permission)."""

    exit_status = 5


class QualityError(KeyssError):
    """What was made is not good enough to be given out."""

    exit_status = 7


class BackendError(KeyssError):
    """A backend or an optional dependency that is not there."""

    exit_status = 6
