"""What a person is told who misspelt something."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cli.said import COMMANDS, Said
from keyss.cli import suggestions
from keyss.cli.entry import application

Run = Callable[..., Said]


def hint(said: Said) -> str:
    assert (said.status, said.out) == (2, "")
    return said.err.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("revael", "x"), "`keyss reveal`"),
        (("Hide",), "`keyss hide`"),
        (("--quiet", "inof", "x"), "`keyss info`"),
        (("reveal", "a", "--keyfile", "k", "-o", "b"), "--key-file instead of --keyfile"),
        (("hide", "--cover", "a", "--seckret=b"), "--secret instead of --seckret"),
        (("hide", "--strat", "--cover", "a", "-o", "b"), "--start instead of --strat"),
        (("fit", "a", "--widht", "9", "--overwite"), "--overwrite instead of --overwite, --width"),
        (("hide", "--method", "carry", "--prune-to-fitt"), "--prune-to-fit instead"),
    ],
)
def test_a_misspelt_command_or_option(keyss: Run, arguments: tuple[str, ...], meant: str) -> None:
    assert hint(keyss(*arguments)).startswith(f"keyss: did you mean {meant}")


@pytest.mark.parametrize("arguments", [("frobnicate",), ("info", "x", "--zzz"), ("fit",), ("render", "x")])
def test_no_idea_no_hint(keyss: Run, arguments: tuple[str, ...]) -> None:
    assert "did you mean" not in hint(keyss(*arguments))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_of_the_help_is_known(keyss: Run, command: str) -> None:
    """The help is what the parser takes; what is known of a command's options comes from its signature."""
    known = suggestions.options_of(application([command]).found[command])
    lines = (line.strip("│ ") for line in keyss(command, "--help").out.splitlines())
    offered = {flag for line in lines if line.startswith("-") for flag in re.findall(r"--[a-z][a-z-]*", line)}
    assert offered - {"--help"} == known


class TestPaths:
    @pytest.fixture(autouse=True)
    def here(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "runs" / "garden").mkdir(parents=True)
        (tmp_path / "runs" / "garden" / "stego.ply").write_bytes(b"ply")
        monkeypatch.chdir(tmp_path)

    @pytest.mark.parametrize(
        "path",
        ["runs/garden/steg.ply", "runs/gardem/stego.ply", "run/Garden/stegi.ply", "./runs/garden/sego.ply"],
    )
    def test_one_that_is_nearly_there(self, keyss: Run, path: str) -> None:
        said = keyss("info", path)
        assert said.status == 4
        assert said.err.endswith("; did you mean runs/garden/stego.ply?\n")
        assert said.err.count("\n") == 1

    def test_from_the_root(self, keyss: Run, tmp_path: Path) -> None:
        said = keyss("info", tmp_path / "runs" / "gardn")
        assert said.err.endswith(f"; did you mean {tmp_path / 'runs' / 'garden'}?\n")

    @pytest.mark.parametrize(
        "path", ["runs/garden/stego.ply", "elsewhere/stego.ply", "x" * 5000, "runs/\x01"]
    )
    def test_what_is_there_or_like_nothing(self, keyss: Run, path: str) -> None:
        said = keyss("info", path)
        assert said.status == 4
        assert "did you mean" not in said.err

    def test_names_that_are_no_text(self, keyss: Run) -> None:
        os.mkdir(b"runs/gard\xffn\n2")
        said = keyss("info", "runs/gard?n?2")
        assert said.status == 4
        assert len(said.err.splitlines()) == 1

    @given(st.text(max_size=30), st.text(max_size=60))
    def test_any_words(self, word: str, message: str) -> None:
        suggestions.existing_path(f"{message}{word}", [word, message])
        suggestions.meant([word, message], COMMANDS, {"--key-file"})


def test_a_large_folder_takes_no_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suggestions, "_MOST_NAMES", 100)
    for number in range(300):
        (tmp_path / f"{number:03}-model.ply").touch()
    assert len(list(suggestions._names(tmp_path))) == 100
