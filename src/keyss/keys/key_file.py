"""Normalisation of keys, random keys, their strength, and key files."""

from __future__ import annotations

import math
import os
import secrets
import string
import sys
import unicodedata
import warnings
from contextlib import nullcontext
from pathlib import Path

from keyss.core.errors import InputError, KeyssWarning, OutputError, UsageError
from keyss.files.inputs import is_standard

MAX_KEY_BYTES = 4096
_TOO_LONG = f"the key is longer than {MAX_KEY_BYTES} bytes"
ALPHABET = string.ascii_letters + string.digits
LONG_KEY_LENGTH = 22  # characters of derived keys and sweeps' master keys: 131 bits, at 5.95 per character
# Argon2id costs 0.1 s of a core and 64 MiB per guess: these take three hundred thousand years of one core.
_ENOUGH_GUESSES = 1e14
_MAX_RATED = 100  # characters; zxcvbn takes superlinear time
_SPACES = "\t\n\v\f\r \u1680\u2028\u2029\ufeff"  # as JavaScript's `trim`, without those that NFKC replaces


def normalized_key(text: str) -> str:
    """The key in `text`: Unicode's form NFKC without surrounding white space.

    Everything that takes a key applies this, so a final newline or a byte order mark never counts. Warns of
    other white space that it drops. Raises UsageError for a key that is empty, longer than 4096 bytes, or not
    UTF-8; the message omits the key.
    """
    if len(text) > 2 * MAX_KEY_BYTES:  # normalising takes quadratic time, and may shorten a text
        raise UsageError(_TOO_LONG)
    form = unicodedata.normalize("NFKC", text)
    key = form.strip(_SPACES)
    if not key:
        raise UsageError("the key is empty")
    if form.removeprefix("\ufeff").removesuffix("\n").removesuffix("\r") != key:
        warnings.warn("white space around the key does not count", KeyssWarning, stacklevel=3)
    try:
        size = len(key.encode())
    except UnicodeEncodeError:
        raise UsageError("expected a key in UTF-8, found other bytes") from None
    if size > MAX_KEY_BYTES:
        raise UsageError(_TOO_LONG)
    return key


def read_key(path: str | Path) -> str:
    """Read a key file, or "-" for standard input. Raises InputError for a file without a key."""
    path = Path(path)
    try:
        with nullcontext(sys.stdin.buffer) if is_standard(path) else path.open("rb") as file:
            data = file.read(2 * MAX_KEY_BYTES)
    except OSError as error:
        raise InputError(f"{path}: the key file cannot be read: {error.strerror}") from error
    try:
        return normalized_key(data.decode(errors="surrogateescape"))
    except UsageError as error:
        raise InputError(f"{path}: {error}; `keyss keygen -o FILE` writes a key file") from error


def write_new_key(path: Path, key: str) -> None:
    """Write a key file that only its owner can read (on Windows, everyone who can read its folder).

    Raises OutputError if the path exists.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise OutputError(f"{path} exists, and a key is never replaced: choose another name") from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(f"{key}\n")
            file.flush()
            os.fsync(descriptor)
    except BaseException as error:
        path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        raise


def generate_key(length: int = 16) -> str:
    """A random alphanumeric key from the system's random source: 5.95 bits per character.

    Raises UsageError for a length outside 1 to 1024.
    """
    if not 1 <= length <= 1024:
        raise UsageError(f"a key has 1 to 1024 characters, not {length}")
    return "".join(secrets.choice(ALPHABET) for _ in range(length))


def length_for(bits: int) -> int:
    """Minimum length for which `generate_key` gives `bits` of entropy."""
    return math.ceil(bits / math.log2(len(ALPHABET)))


def key_guesses(key: str) -> float:
    """The number of guesses that find `key` after `normalized_key`. Raises UsageError for an invalid key.

    zxcvbn (Wheeler 2016) estimates guesses from patterns in chosen passwords: words, names, dates, keyboards,
    repetitions. It counts a random character, even a letter, as ten guesses: 10^16 for a generated key of 16.
    It cannot detect a key reused from elsewhere.
    """
    from zxcvbn import zxcvbn  # slow to import

    return float(zxcvbn(normalized_key(key)[:_MAX_RATED], max_length=_MAX_RATED)["guesses"])


def weakness(key: str) -> str | None:
    """A warning for a weak key, None for a strong one."""
    guesses = key_guesses(key)
    if guesses >= _ENOUGH_GUESSES:
        return None
    return (
        f"about 10^{math.log10(guesses):.0f} guesses find this key, and whoever has the published file can "
        "make them; `keyss keygen` makes keys that nobody guesses"
    )
