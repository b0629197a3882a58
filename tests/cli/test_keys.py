"""Keys from files, the environment, the prompt and `keyss keygen`."""

from __future__ import annotations

import getpass
import io
import os
from contextlib import nullcontext
from pathlib import Path

import pytest

from channels.lsb.trained_like import trained_like
from cli.harness import Run, assert_refused, write_key
from keyss.cli import keys
from keyss.core import InputError, KeyssWarning, UsageError
from keyss.files import write_model
from keyss.keys import DerivedKey, MasterKey, generate_key, read_key


@pytest.fixture(autouse=True)
def _no_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KEYSS_KEY", raising=False)


def write(folder: Path, data: bytes) -> Path:
    path = folder / "key"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("data", "key", "warns"),
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
def test_white_space_is_stripped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: bytes, key: str, warns: bool
) -> None:
    """In files, in the environment and in Python."""
    with pytest.warns(KeyssWarning, match="white space") if warns else nullcontext():
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
def test_invalid_key_files(tmp_path: Path, data: bytes, words: str) -> None:
    with pytest.raises(InputError, match=words):
        keys.key_of_file(write(tmp_path, data))


def test_key_file_takes_precedence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
        """Answers at the prompt, filled by the test."""
        answers: list[str] = []
        monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
        monkeypatch.setattr(getpass, "getpass", lambda prompt: answers.pop(0))
        return answers

    def test_confirms_when_hiding(self, typed: list[str]) -> None:
        typed += ["one", "one", "two", "two"]
        assert keys.keys([], 2, new=True) == ["one", "two"]
        typed += ["three"]
        assert keys.keys([], 1) == ["three"]
        assert typed == []

    def test_mismatch_is_refused(self, typed: list[str]) -> None:
        typed += ["one", "onw"]
        with pytest.raises(UsageError, match="differ"):
            keys.keys([], 1, new=True)
        typed += [""]
        with pytest.raises(UsageError, match="empty"):
            keys.keys([], 1, new=True)


def test_readable_key_file_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, b"tell nobody")
    path.chmod(0o600)
    keys.key_of_file(path)
    assert capsys.readouterr().err == ""
    path.chmod(0o640)
    keys.key_of_file(path)
    err = capsys.readouterr().err
    assert "others can read" in err
    assert "tell nobody" not in err


def test_weak_key_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [write_key(tmp_path / "strong", generate_key(20)), write_key(tmp_path / "weak", "hunter2")]
    keys.keys(files[:1], 1, new=True)
    assert capsys.readouterr().err == ""
    keys.keys(files, 2, new=True)
    err = capsys.readouterr().err
    assert "key 2: " in err
    assert "guesses" in err
    assert "hunter2" not in err


def test_key_from_standard_input(keyss: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key = "q7Rv2LxT9bWm4KzD"
    write_model(tmp_path / "cover.ply", trained_like(1500))
    write_model(tmp_path / "small.ply", trained_like(100, 1))
    hide = ("hide", "--cover", tmp_path / "cover.ply", "--secret", tmp_path / "small.ply", "--width", 16)
    write_key(tmp_path / "key.txt", key)
    done = keyss(*hide, "--key-file", tmp_path / "key.txt", "-o", tmp_path / "run")
    assert done.status == 0, done.err
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(f"{key}\n".encode())))
    stego = tmp_path / "run" / "publish" / "model.ply"
    assert keyss("reveal", stego, "--key-file", "-", "-o", tmp_path / "out.ply").status == 0
    for files in ((stego, "--key-file", "-", "--key-file", "-"), ("-", "--key-file", "-")):
        assert_refused(keyss("verify", *files), 2, "- is given twice, and standard input holds one")
    twice = keyss("verify", stego, "--key-file", tmp_path / "key.txt", "--key-file", tmp_path / "key.txt")
    assert "secret of key 1" in twice.out
    assert "secret of key 2" in twice.out


def test_output_onto_a_dangling_link(keyss: Run, tmp_path: Path) -> None:
    write_model(tmp_path / "a.ply", trained_like(50))
    (tmp_path / "out.ply").symlink_to(tmp_path / "nowhere.ply")
    refused = keyss("convert", tmp_path / "a.ply", "-o", tmp_path / "out.ply")
    assert_refused(refused, 5, "is a link to")
    assert (tmp_path / "out.ply").is_symlink()


MASTER = "q7Rv2LxT9bWm4KzDq7Rv2L"


def test_prints_key(keyss: Run) -> None:
    result = keyss("keygen")
    assert result.status == 0
    assert result.err == ""
    assert result.out.endswith("\n")
    key = result.out.removesuffix("\n")
    assert len(key) == 16
    assert key.isascii()
    assert key.isalnum()
    assert keyss("keygen").out != result.out


def test_bits(keyss: Run) -> None:
    assert len(keyss("keygen", "--bits", 128).out) == 22 + 1
    weak = keyss("keygen", "--bits", 8)
    assert (weak.status, len(weak.out)) == (0, 2 + 1)
    assert "warning: a key of 8 bits is found by 2^8 guesses" in weak.err
    assert_refused(keyss("keygen", "--bits", 0), 2, "--bits")
    assert_refused(keyss("keygen", "--bits", 10_000), 2, "1 to 1024")


def test_asset_key(keyss: Run, tmp_path: Path) -> None:
    master = write_key(tmp_path / "master.txt", MASTER)
    expected = MasterKey(MASTER).key_of("statue-7")
    asset = ("keygen", "--asset", "statue-7")
    assert keyss(*asset, "--master-key-file", master).out == f"{expected}\n"
    out = tmp_path / "statue-7.key"
    result = keyss(*asset, "--master-key-file", master, "-o", out)
    assert result.status == 0, result
    assert out.read_text().strip() == expected
    assert expected not in result.out
    assert out.stat().st_mode & 0o777 == 0o600
    assert_refused(keyss(*asset), 2, "--master-key-file")
    assert_refused(keyss(*asset, "--master-key-file", master, "--bits", 9), 2, "--bits")


def test_key_file(keyss: Run, tmp_path: Path, umask: None) -> None:
    path = tmp_path / "key.txt"
    result = keyss("keygen", "-o", path)
    key = read_key(path)
    assert (result.status, result.err) == (0, "")
    assert str(path) in result.out
    assert key not in result.out
    assert len(key) == 16
    assert path.stat().st_mode & 0o777 == 0o600
    assert_refused(keyss("keygen", "-o", path), 5, "never replaced")
    assert read_key(path) == key
    path.with_name("link").symlink_to(tmp_path / "elsewhere")
    assert_refused(keyss("keygen", "-o", tmp_path / "link"), 5, "never replaced")
    assert_refused(keyss("keygen", "-o", tmp_path / "none" / "key"), 5, "No such file")
    assert {path.name for path in tmp_path.iterdir()} == {"key.txt", "link"}
