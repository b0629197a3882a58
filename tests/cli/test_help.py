"""--help, --version, usage errors and suggestions."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from cli.harness import COMMANDS, Result, Run, assert_refused
from keyss import __version__


def test_overview(keyss: Run) -> None:
    result = keyss("--help")
    assert (result.status, result.err) == (0, "")
    lines = result.out.splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 100
    assert [line.split()[0] for line in lines if re.match(r"  [a-z]+ ", line)] == COMMANDS
    assert len(COMMANDS) == 16


@pytest.mark.parametrize("command", COMMANDS)
def test_example_and_common_options(keyss: Run, command: str) -> None:
    status, out, _ = keyss(command, "--help")
    assert status == 0
    assert f"example: keyss {command}" in out
    assert "default: None" not in out
    random = {"fit", "hide", "audit", "compare", "reproduce", "demo"}
    assert ("--seed" in out) == (command in random)
    computing = {"fit", "hide", "reveal", "verify", "render", "convert", "evaluate", "audit", "demo"}
    computing |= {"doctor", "compare", "reproduce"}
    assert ("--device {auto,cpu,cuda}" in out) == (command in computing)
    assert "nothing here" not in out


def test_hide_snapshot(keyss: Run) -> None:
    expected = Path(__file__).with_name("hide_carry_help.txt").read_text(encoding="utf-8")
    out = keyss("hide", "--method", "carry", "--help").out
    assert [line.rstrip() for line in out.splitlines()] == expected.splitlines()


def test_help_does_not_import_torch() -> None:
    """torch takes seconds to load."""
    program = """
import sys
from keyss.cli import main
try:
    main({})
finally:
    assert "torch" not in sys.modules
"""
    for arguments in (["--help"], ["keygen", "--help"]):
        subprocess.run([sys.executable, "-c", program.format(arguments)], check=True, capture_output=True)


@pytest.mark.parametrize("arguments", [("--version",), ("-V",)])
def test_version(keyss: Run, arguments: tuple[str, ...]) -> None:
    assert keyss(*arguments) == Result(0, f"{__version__}\n", "")


@pytest.mark.parametrize("arguments", [("frobnicate",), ("fit",), ("info", "x", "--nonsense")])
def test_usage_errors(keyss: Run, arguments: tuple[str, ...]) -> None:
    result = keyss(*arguments)
    assert result.status == 2
    assert result.out == ""
    assert result.err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("revael", "x"), "did you mean reveal?"),
        (("Hide",), "did you mean hide?"),
        (("--quiet", "inof", "x"), "did you mean info?"),
        (("frobnicate",), "expected one of audit, compare, "),
    ],
)
def test_misspelt_command(keyss: Run, arguments: tuple[str, ...], expected: str) -> None:
    assert_refused(keyss(*arguments), 2, expected)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("reveal", "a", "--keyfile", "k", "-o", "b"), "has no option --keyfile: did you mean --key-file?"),
        (("hide", "--covr", "a"), "did you mean --cover?"),  # although required options are missing
        (("hide", "--cover", "a", "--seckret=b", "-o", "c"), "did you mean --secret?"),
        (("hide", "--cover", "a", "--min_psnrr", "-o", "c"), "did you mean --min-psnr?"),
        (("hide", "--preset", "quik"), "--preset: expected one of quick, default, full, got 'quik'"),
        (("hide", "--format", "splat"), "expected one of ply, spz, sog, compressed-ply, got"),
        (("hide", "--fine-tune", "no"), "expected one of auto, always, never"),
    ],
)
def test_misspelt_option(keyss: Run, arguments: tuple[str, ...], expected: str) -> None:
    assert_refused(keyss(*arguments), 2, expected)
