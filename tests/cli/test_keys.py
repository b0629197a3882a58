"""Where keys come from."""

from __future__ import annotations

import getpass
import os
from contextlib import nullcontext
from pathlib import Path

import pytest

from keyss.cli import keys
from keyss.core import InputError, KeyssWarning, UsageError
from keyss.keys import DerivedKey, generate_key


@pytest.fixture(autouse=True)
def _no_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KEYSS_KEY", raising=False)


def write(folder: Path, data: bytes) -> Path:
    path = folder / "key"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("data", "key", "said"),
    [
        (b"abc", "abc", False),
        (b"abc\n", "abc", False),
        (b"abc\r\n", "abc", False),
        (b"abc\n\n", "abc", True),
        (b"\t a b ", "a b", True),
        ("\N{NO-BREAK SPACE}Schlüssel 鍵\N{IDEOGRAPHIC SPACE}".encode(), "Schlüssel 鍵", True),
        ("abc\r\n".encode("utf-8-sig"), "abc", False),
        ("\N{LATIN SMALL LIGATURE FI}n".encode(), "fin", False),
        (b"x" * 4096 + b"\n", "x" * 4096, False),
    ],
)
@pytest.mark.filterwarnings("ignore:white space")
def test_surrounding_white_space_never_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: bytes, key: str, said: bool
) -> None:
    """The file, the environment and whoever passes the text of a file in Python have the same key."""
    with pytest.warns(KeyssWarning, match="white space") if said else nullcontext():
        assert keys.keys([write(tmp_path, data)], 1) == [key]
    monkeypatch.setenv("KEYSS_KEY", data.decode())
    assert keys.keys([], 1) == [key]
    one, other = (DerivedKey.of(each, bytes(16)) for each in (data.decode(), key))
    assert one.verifier() == other.verifier()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "empty"),
        (b"\n", "empty"),
        (b" \r\n", "empty"),
        (b"x" * 4097, "4096 bytes"),
        (b"\xff\xfe", "UTF-8"),
    ],
)
def test_files_that_hold_no_key_are_refused(tmp_path: Path, data: bytes, words: str) -> None:
    with pytest.raises(InputError, match=words):
        keys.key_of_file(write(tmp_path, data))


def test_files_come_before_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KEYSS_KEY", "from the environment")
    assert keys.keys([write(tmp_path, b"from the file\n")], 1) == ["from the file"]
    assert keys.keys([], 1) == ["from the environment"]
    with pytest.raises(UsageError, match="2 secrets"):
        keys.keys([], 2)
    monkeypatch.setenv("KEYSS_KEY", "")
    with pytest.raises(UsageError, match="KEYSS_KEY: the key is empty"):
        keys.keys([], 1)
    monkeypatch.setenv("KEYSS_KEY", os.fsdecode(b"\xff"))
    with pytest.raises(UsageError, match="UTF-8"):
        keys.keys([], 1)


class TestPrompt:
    @pytest.fixture
    def typed(self, monkeypatch: pytest.MonkeyPatch) -> list[str]:
        """What a person types, to be filled by the test."""
        answers: list[str] = []
        monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
        monkeypatch.setattr(getpass, "getpass", lambda prompt: answers.pop(0))
        return answers

    def test_asks_once_to_open_and_twice_to_lock(self, typed: list[str]) -> None:
        typed += ["one", "one", "two", "two"]
        assert keys.keys([], 2, confirm=True) == ["one", "two"]
        typed += ["three"]
        assert keys.keys([], 1) == ["three"]
        assert typed == []

    def test_refuses_a_slip(self, typed: list[str]) -> None:
        typed += ["one", "onw"]
        with pytest.raises(UsageError, match="differ"):
            keys.keys([], 1, confirm=True)
        typed += [""]
        with pytest.raises(UsageError, match="empty"):
            keys.keys([], 1, confirm=True)


def test_a_key_file_that_others_can_read_gets_a_warning_without_the_key(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, b"tell nobody")
    path.chmod(0o600)
    keys.key_of_file(path)
    assert capsys.readouterr().err == ""
    path.chmod(0o640)
    keys.key_of_file(path)
    said = capsys.readouterr().err
    assert "others can read" in said
    assert "tell nobody" not in said


def test_weak_keys_get_a_warning_without_the_key(capsys: pytest.CaptureFixture[str]) -> None:
    keys.warn_of_weak_keys([generate_key(20)])
    assert capsys.readouterr().err == ""
    keys.warn_of_weak_keys([generate_key(20), "hunter2"])
    said = capsys.readouterr().err
    assert "key 2: " in said
    assert "guesses" in said
    assert "hunter2" not in said
