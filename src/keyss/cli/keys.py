"""Where keys come from: files, the environment or a prompt, but never arguments, which others can see."""

from __future__ import annotations

import getpass
import os
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from keyss._torchrun import processes
from keyss.core.errors import UsageError, WrongKeyError
from keyss.keys.key_file import read_key_file, write_new_key as write_new_key

VARIABLE = "KEYSS_KEY"


def keys(files: Sequence[Path], count: int, *, confirm: bool = False) -> list[str]:
    """`count` keys, from `files`, else from the environment, else from a prompt.

    `confirm`: ask twice, for keys to hide with. Raises UsageError if the numbers differ or there is no
    terminal for a prompt, InputError for a file without a key.
    """
    if files:
        if len(files) != count:
            expected = "one --key-file" if count == 1 else f"one --key-file for each of {count} secrets"
            raise UsageError(f"expected {expected}, got {len(files)}")
        return [key_of_file(path) for path in files]
    if VARIABLE in os.environ:
        if count != 1:
            raise UsageError(
                f"{VARIABLE} holds one key, but there are {count} secrets: give --key-file for each"
            )
        return [_checked(os.environ[VARIABLE], VARIABLE)]
    if not sys.stdin.isatty() or processes() > 1:
        raise UsageError(f"no key: give --key-file FILE, set {VARIABLE}, or run in a terminal for a prompt")
    return [_ask(f"Key {i + 1} of {count}" if count > 1 else "Key", confirm) for i in range(count)]


def keys_of_run(run: Path, files: Sequence[Path]) -> list[str]:
    """The keys of a run's secrets: as many as files, else one; none if its method has no keys."""
    from keyss.methods import registry
    from keyss.runs.config import read_config
    from keyss.runs.files import CONFIG, is_run

    if not files and is_run(run) and not registry.get(read_config(run / CONFIG).method).capabilities.keys:
        return []
    return keys(files, len(files) or 1)


def warn_of_doubtful_keys(chosen: Sequence[str]) -> None:
    """Warn of keys that are easy to guess or have white space at an end, without showing them."""
    from keyss.keys import weakness

    for number, key in enumerate(chosen, start=1):
        for problem in filter(None, (weakness(key), _white_space(key))):
            which = f"key {number}: " if len(chosen) > 1 else ""
            print(f"keyss: warning: {which}{problem}", file=sys.stderr)


@contextmanager
def hinting_at_white_space(chosen: Sequence[str]) -> Iterator[None]:
    """Adds a hint to WrongKeyError if a key has white space at an end."""
    try:
        yield
    except WrongKeyError as error:
        hints = {hint for key in chosen if (hint := _white_space(key))}
        raise WrongKeyError("; ".join((str(error), *sorted(hints)))) from error


def _white_space(key: str) -> str | None:
    if key == key.strip():
        return None
    end = "begins" if key != key.lstrip() else "ends"
    which = key[0] if end == "begins" else key[-1]
    kind = "a space" if which == " " else "a line break" if which in "\r\n" else "white space"
    return f"the key {end} with {kind}, which is a part of it"


def key_of_file(path: Path) -> str:
    """The text of a key file without one newline at its end; warns if others can read it.

    Raises InputError for a file without a key.
    """
    key, mode = read_key_file(path)
    if os.name == "posix" and stat.S_ISREG(mode) and mode & (stat.S_IRGRP | stat.S_IROTH):
        print(
            f"keyss: warning: {path}: others can read this key file; protect it with `chmod 600`",
            file=sys.stderr,
        )
    return key


def _ask(prompt: str, confirm: bool) -> str:
    try:
        key = getpass.getpass(f"{prompt}: ")
        if confirm and key and getpass.getpass(f"{prompt} again: ") != key:
            raise UsageError("the two keys differ")
    except EOFError as error:
        raise UsageError("no key was typed") from error
    return _checked(key, "the key")


def _checked(key: str, where: str) -> str:
    """`key`, if it is not empty and valid UTF-8. Raises UsageError."""
    if not key:
        raise UsageError(f"{where} is empty")
    try:
        key.encode()
    except UnicodeEncodeError as error:
        raise UsageError(f"{where}: expected UTF-8 text, found other bytes") from error
    return key
