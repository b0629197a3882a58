"""`keyss keygen`."""

from __future__ import annotations

from collections.abc import Callable

from cli.said import Said, assert_refused


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

    def test_takes_no_seed(self, keyss: Callable[..., Said]) -> None:
        """A key that can be drawn again is no secret."""
        assert keyss("keygen", "--seed", 1).status == 2
