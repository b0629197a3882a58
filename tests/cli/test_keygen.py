"""`keyss keygen`."""

from __future__ import annotations

from pathlib import Path

from cli.harness import Run, assert_refused, write_key
from keyss.keys import MasterKey, read_key

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
