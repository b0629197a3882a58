"""`keyss keygen`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from cli.said import Said, assert_refused
from keyss.cli.keys import key_of_file


class TestKeygen:
    def test_prints_a_key_and_nothing_else(self, keyss: Callable[..., Said]) -> None:
        said = keyss("keygen")
        assert said.status == 0
        assert said.err == ""
        assert said.out.endswith("\n")
        key = said.out.removesuffix("\n")
        assert len(key) == 16
        assert key.isascii()
        assert key.isalnum()
        assert keyss("keygen").out != said.out

    def test_length(self, keyss: Callable[..., Said]) -> None:
        assert len(keyss("keygen", "--length", 40).out) == 41
        assert_refused(keyss("keygen", "--length", 0), 2, "1 to 1024")

    def test_bits(self, keyss: Callable[..., Said]) -> None:
        assert len(keyss("keygen", "--bits", 128).out) == 22 + 1
        assert_refused(keyss("keygen", "--bits", 128, "--length", 9), 2, "not both")
        assert_refused(keyss("keygen", "--bits", 0), 2, "--bits")

    def test_a_key_file_is_its_owners_and_never_replaced(
        self, keyss: Callable[..., Said], tmp_path: Path
    ) -> None:
        path = tmp_path / "key.txt"
        umask = os.umask(0o022)
        try:
            said = keyss("keygen", "-o", path)
        finally:
            os.umask(umask)
        key = key_of_file(path)
        assert (said.status, said.err) == (0, "")
        assert str(path) in said.out
        assert key not in said.out
        assert len(key) == 16
        assert path.stat().st_mode & 0o777 == 0o600
        assert_refused(keyss("keygen", "-o", path), 5, "never replaced")
        assert key_of_file(path) == key
        path.with_name("link").symlink_to(tmp_path / "elsewhere")
        assert_refused(keyss("keygen", "-o", tmp_path / "link"), 5, "never replaced")
        assert_refused(keyss("keygen", "-o", tmp_path / "none" / "key"), 5, "No such file")
        assert {each.name for each in tmp_path.iterdir()} == {"key.txt", "link"}

    def test_takes_no_seed(self, keyss: Callable[..., Said]) -> None:
        """A key that can be drawn again is no secret."""
        assert keyss("keygen", "--seed", 1).status == 2
