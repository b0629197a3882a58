"""Where keys come from: files, the environment, a hidden prompt; never arguments, which others see."""

from __future__ import annotations

import getpass
import os
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from keyss.core.errors import InputError, OutputError, UsageError, WrongKeyError

VARIABLE = "KEYSS_KEY"
MAX_FILE_BYTES = 4096


def keys(files: Sequence[Path], count: int, *, confirm: bool = False) -> list[str]:
    """`count` keys: those of `files` if there are any, else of the environment, else asked for.

    `confirm` asks twice, for keys that lock rather than open. Raises UsageError when the numbers do not
    fit or there is nowhere to ask, InputError for a file that holds no key.
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
    if not sys.stdin.isatty():
        raise UsageError(f"no key: give --key-file FILE, set {VARIABLE}, or run in a terminal and be asked")
    return [_ask(f"Key {i + 1} of {count}" if count > 1 else "Key", confirm) for i in range(count)]


def keys_of_run(run: Path, files: Sequence[Path]) -> list[str]:
    """The keys of a run's secrets: as many as there are files, or one; none where its method has none."""
    from keyss.methods import registry
    from keyss.runs.config import read_config
    from keyss.runs.files import CONFIG, is_run

    if not files and is_run(run) and not registry.get(read_config(run / CONFIG).method).capabilities.keys:
        return []
    return keys(files, len(files) or 1)


def warn_of_doubtful_keys(chosen: Sequence[str]) -> None:
    """Say on the standard error stream which of the keys can be guessed or were hardly meant like that.

    What they are is not said.
    """
    from keyss.keys import weakness

    for number, key in enumerate(chosen, start=1):
        for problem in filter(None, (weakness(key), _white_space(key))):
            which = f"key {number}: " if len(chosen) > 1 else ""
            print(f"keyss: warning: {which}{problem}", file=sys.stderr)


@contextmanager
def hinting_at_white_space(chosen: Sequence[str]) -> Iterator[None]:
    """Adds to the error of keys that open nothing what may be wrong with them."""
    try:
        yield
    except WrongKeyError as error:
        hints = {hint for key in chosen if (hint := _white_space(key))}
        raise WrongKeyError("; ".join((str(error), *sorted(hints)))) from error


def _white_space(key: str) -> str | None:
    """What to say of a key with white space at an end, which nobody sees."""
    if key == key.strip():
        return None
    end = "begins" if key != key.lstrip() else "ends"
    which = key[0] if end == "begins" else key[-1]
    kind = "a space" if which == " " else "a line break" if which in "\r\n" else "white space"
    return f"the key {end} with {kind}, which is a part of it"


def write_new_key(path: Path, key: str) -> None:
    """Write a key file that only its owner can read. Raises OutputError where there is anything already."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise OutputError(f"{path} exists, and a key is never replaced: choose another name") from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            os.fchmod(descriptor, 0o600)  # whatever the umask
            file.write(f"{key}\n")
            file.flush()
            os.fsync(descriptor)
    except BaseException as error:
        path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        raise


def key_of_file(path: Path) -> str:
    """The text of a key file without one newline at its end; warns of one that others may read.

    Raises InputError for a file that holds no key.
    """
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            if os.name == "posix" and stat.S_ISREG(mode) and mode & (stat.S_IRGRP | stat.S_IROTH):
                print(
                    f"keyss: warning: {path}: others can read this key file; `chmod 600` keeps it to you",
                    file=sys.stderr,
                )
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: the key file cannot be read: {error.strerror}") from error
    if len(data) > MAX_FILE_BYTES:
        raise InputError(f"{path}: expected a key file of at most {MAX_FILE_BYTES} bytes, found more")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected a key in UTF-8, found other bytes") from error
    key = text.removesuffix("\n").removesuffix("\r")
    if not key:
        raise InputError(f"{path}: the key file is empty; `keyss keygen -o FILE` writes a key")
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
    """`key`, if it is text that can be encoded. Raises UsageError."""
    if not key:
        raise UsageError(f"{where} is empty")
    try:
        key.encode()
    except UnicodeEncodeError as error:
        raise UsageError(f"{where}: expected UTF-8 text, found other bytes") from error
    return key
