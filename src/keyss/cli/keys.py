"""Read keys from files, the environment or a prompt, but never from arguments, which others can see."""

from __future__ import annotations

import getpass
import os
import stat
import sys
from collections.abc import Sequence
from pathlib import Path

from keyss.core.errors import UsageError
from keyss.files.inputs import is_standard
from keyss.keys.key_file import normalized_key, read_key

VARIABLE = "KEYSS_KEY"


def keys(files: Sequence[Path], count: int, *, new: bool = False) -> list[str]:
    """Read `count` keys from `files`, else from the environment, else from a prompt.

    `new`: prompt twice, and warn of keys that are easy to guess. Raises UsageError if `files` are not `count`
    or there is no terminal for a prompt, InputError for a file without a key.
    """
    if files and len(files) != count:
        expected = "one --key-file" if count == 1 else f"one --key-file for each of {count} secrets"
        raise UsageError(f"expected {expected}, got {len(files)}")
    if files or VARIABLE in os.environ:
        chosen = given_keys(files)
        if len(chosen) != count:
            raise UsageError(
                f"{VARIABLE} holds one key, but there are {count} secrets: give --key-file for each"
            )
    elif not sys.stdin.isatty():
        raise UsageError(f"no key: give --key-file FILE, set {VARIABLE}, or run in a terminal for a prompt")
    else:
        chosen = [_prompt(f"Key {i + 1} of {count}" if count > 1 else "Key", new) for i in range(count)]
    if new:
        from keyss.keys import weakness

        for number, key in enumerate(chosen, start=1):
            if problem := weakness(key):
                which = f"key {number}: " if len(chosen) > 1 else ""
                print(f"keyss: warning: {which}{problem}", file=sys.stderr)
    return chosen


def given_keys(files: Sequence[Path]) -> list[str]:
    """The keys in `files`, else the one in the environment, else none: for commands with optional keys."""
    if files or VARIABLE not in os.environ:
        return [key_of_file(path) for path in files]
    try:
        return [normalized_key(os.environ[VARIABLE])]
    except UsageError as error:
        raise UsageError(f"{VARIABLE}: {error}") from error


def keys_of_run(run: Path, files: Sequence[Path]) -> list[str]:
    """The keys of a run's secrets: one per file, else one; none if its method has no keys."""
    from keyss.methods import registry
    from keyss.runs.files import CONFIG, run_folder
    from keyss.runs.run_records import read_config

    if not files:
        method = read_config(run_folder(run) / CONFIG).method
        if not registry.get(method).capabilities.keys:
            return []
    return keys(files, len(files) or 1)


def key_of_file(path: Path) -> str:
    """Read a key file, or standard input; warns if others can read it. Raises InputError without a key."""
    key = read_key(path)
    mode = 0 if is_standard(path) else path.stat().st_mode
    if os.name == "posix" and stat.S_ISREG(mode) and mode & (stat.S_IRGRP | stat.S_IROTH):
        print(
            f"keyss: warning: {path}: others can read this key file; protect it with `chmod 600`",
            file=sys.stderr,
        )
    return key


def _prompt(prompt: str, confirm: bool) -> str:
    try:
        key = normalized_key(getpass.getpass(f"{prompt}: "))
        if confirm and normalized_key(getpass.getpass(f"{prompt} again: ")) != key:
            raise UsageError("the two keys differ")
    except EOFError as error:
        raise UsageError("no key was typed") from error
    return key
