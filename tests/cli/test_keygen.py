"""`keyss keygen`."""

from __future__ import annotations

from pathlib import Path

from cli.said import Run, assert_refused, write_key
from keyss.keys import MasterKey, read_key

MASTER = "q7Rv2LxT9bWm4KzDq7Rv2L"


class TestKeygen:
    def test_prints_a_key_and_nothing_else(self, keyss: Run) -> None:
        said = keyss("keygen")
        assert said.status == 0
        assert said.err == ""
        assert said.out.endswith("\n")
        key = said.out.removesuffix("\n")
        assert len(key) == 16
        assert key.isascii()
        assert key.isalnum()
        assert keyss("keygen").out != said.out

    def test_bits(self, keyss: Run) -> None:
        assert len(keyss("keygen", "--bits", 128).out) == 22 + 1
        assert_refused(keyss("keygen", "--bits", 0), 2, "--bits")
        assert_refused(keyss("keygen", "--bits", 10_000), 2, "1 to 1024")

    def test_the_key_of_an_asset_follows_from_the_master_key(self, keyss: Run, tmp_path: Path) -> None:
        master = write_key(tmp_path / "master.txt", MASTER)
        expected = MasterKey(MASTER).key_of("statue-7")
        asset = ("keygen", "--asset", "statue-7")
        assert keyss(*asset, "--master-key-file", master).out == f"{expected}\n"
        out = tmp_path / "statue-7.key"
        said = keyss(*asset, "--master-key-file", master, "-o", out)
        assert said.status == 0, said
        assert out.read_text().strip() == expected
        assert expected not in said.out
        assert out.stat().st_mode & 0o777 == 0o600
        assert_refused(keyss(*asset), 2, "--master-key-file")
        assert_refused(keyss(*asset, "--master-key-file", master, "--bits", 9), 2, "--bits")

    def test_a_key_file_is_its_owners_and_never_replaced(
        self, keyss: Run, tmp_path: Path, umask: None
    ) -> None:
        path = tmp_path / "key.txt"
        said = keyss("keygen", "-o", path)
        key = read_key(path)
        assert (said.status, said.err) == (0, "")
        assert str(path) in said.out
        assert key not in said.out
        assert len(key) == 16
        assert path.stat().st_mode & 0o777 == 0o600
        assert_refused(keyss("keygen", "-o", path), 5, "never replaced")
        assert read_key(path) == key
        path.with_name("link").symlink_to(tmp_path / "elsewhere")
        assert_refused(keyss("keygen", "-o", tmp_path / "link"), 5, "never replaced")
        assert_refused(keyss("keygen", "-o", tmp_path / "none" / "key"), 5, "No such file")
        assert {each.name for each in tmp_path.iterdir()} == {"key.txt", "link"}
