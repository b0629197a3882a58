"""What the help says, and how wrong usage ends."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from cli.said import COMMANDS, Run, Said
from keyss import __version__
from keyss.files import write_model
from keyss.fitting import PRESETS as FIT_PRESETS
from keyss.methods import registry
from tiny_scenes import random_gaussians

LOADS_LITTLE = """
import contextlib, io, sys
from keyss.cli import main

def loaded(*arguments):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main(arguments)
    return set(sys.modules)

assert not loaded("--version") & {"tyro", "rich", "keyss.cli.command_table"}
assert "keyss.cli.hide" not in loaded("keygen")
for arguments in (["--help"], ["keygen", "--help"], ["info", "nowhere"], ["inof"]):
    assert not loaded(*arguments) & {"torch", "numpy", "keyss.methods"}, arguments
model, other = sys.argv[1:]
assert not loaded("info", model) & {"torch", "cv2", "numba", "scipy", "keyss.methods"}
assert not loaded("info", other) & {"numba", "scipy", "keyss.methods"}  # unpacked with torch
"""


class TestHelp:
    def test_fits_on_a_page_with_a_line_for_each_command(self, keyss: Run) -> None:
        said = keyss("--help")
        assert (said.status, said.err) == (0, "")
        lines = said.out.splitlines()
        assert len(lines) <= 45
        assert max(map(len, lines)) <= 100
        assert [line.split()[0] for line in lines if re.match(r"  [a-z]+ ", line)] == COMMANDS
        assert len(COMMANDS) == 16

    @pytest.mark.parametrize("command", COMMANDS)
    def test_shows_an_example(self, keyss: Run, command: str) -> None:
        said = keyss(command, "--help")
        assert said.status == 0
        assert f"example: keyss {command}" in said.out
        assert "default: None" not in said.out

    @pytest.mark.parametrize("command", COMMANDS)
    def test_no_option_is_accepted_and_ignored(self, keyss: Run, command: str) -> None:
        out = keyss(command, "--help").out
        random = {"fit", "hide", "audit", "compare", "reproduce", "demo"}
        assert ("--seed" in out) == (command in random)
        computing = {"fit", "hide", "reveal", "verify", "render", "convert", "evaluate", "audit", "demo"}
        computing |= {"doctor", "compare", "reproduce"}
        assert ("--device {auto,cpu,cuda}" in out) == (command in computing)
        assert "nothing here" not in out

    def test_offers_the_presets_there_are(self, keyss: Run) -> None:
        assert f"--preset {{{','.join(FIT_PRESETS)}}}" in keyss("fit", "--help").out
        for name in registry.METHODS:
            said = keyss("hide", "--method", name, "--help").out
            assert f"--preset {{{','.join(FIT_PRESETS)}}}" in said
            assert "(default: default)" in said

    @pytest.mark.parametrize("method", ["carry"])
    def test_of_hide_is_as_it_was(self, keyss: Run, method: str) -> None:
        """Names, defaults and sentences of all options; `hide_METHOD_help.txt` is what is meant."""
        meant = Path(__file__).with_name(f"hide_{method}_help.txt").read_text(encoding="utf-8")
        said = keyss("hide", "--method", method, "--help").out
        assert [line.rstrip() for line in said.splitlines()] == meant.splitlines()

    def test_what_needs_little_loads_little(self, tmp_path: Path) -> None:
        """Help, a new key and a wrong name answer at once, for torch takes seconds; methods take one more."""
        for name in ("model.ply", "model.splat"):
            write_model(tmp_path / name, random_gaussians(10))
        subprocess.run(
            [sys.executable, "-c", LOADS_LITTLE, tmp_path / "model.ply", tmp_path / "model.splat"],
            check=True,
            stderr=subprocess.DEVNULL,
        )

    @pytest.mark.parametrize("arguments", [("--version",), ("-V",)])
    def test_of_the_version(self, keyss: Run, arguments: tuple[str, ...]) -> None:
        assert keyss(*arguments) == Said(0, f"{__version__}\n", "")

    @pytest.mark.parametrize("arguments", [("frobnicate",), ("fit",), ("info", "x", "--nonsense")])
    def test_wrong_usage_exits_with_2(self, keyss: Run, arguments: tuple[str, ...]) -> None:
        said = keyss(*arguments)
        assert said.status == 2
        assert said.out == ""
        assert said.err
