"""Messages name arguments as Python does below the command line, and as flags on it."""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from cli.said import Run
from keyss.cli import entry
from keyss.core import KeyssWarning, UsageError

SOURCE = Path(__file__).parents[2] / "src" / "keyss"
OPTIONS = {"overwrite", "sh_degree", "key_file", "secret", "publish", "secret_model", "download"}
# Options of other programs, and whole commands, which a page may quote.
QUOTED = re.compile(r"`(keyss|simple_trainer.py|splat-transform|ns-export) [^`]*`|(pip|npm) install [^,)]*")


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ("`overwrite=True` replaces it", "--overwrite replaces it"),
        ('`method="keyss"` can', "--method keyss can"),
        ('`method="carry", dither=True` has one', "--method carry --dither has one"),
        ("`max_gaussians=30000` would do", "--max-gaussians 30000 would do"),
        ("`min_psnr=12.5`", "--min-psnr 12.5"),
        ("`decoy=False`", "no --decoy"),
        ("give `sh_degree`, `publish`", "give --sh-degree, --publish"),
        ("`key`, `secrets` and `model`", "--key-file, --secret and --secret-model"),
        # What is no option of the command stays, whatever it is.
        ("`chmod 600` and `f_dc_0` and `reporter`", "`chmod 600` and `f_dc_0` and `reporter`"),
        ("`keyss keygen -o FILE`", "`keyss keygen -o FILE`"),
        ("x=`; overwrite=True", "x=`; overwrite=True"),
    ],
)
def test_arguments_become_flags(message: str, said: str) -> None:
    assert entry.as_flags(message, OPTIONS) == said


def _strings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Those that a person may read: not documentation, and not the help of the command line."""
    skipped = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            skipped.add(node.value)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "CommandLineOption":
            skipped |= {each for each in ast.walk(node) if isinstance(each, ast.Constant)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in skipped:
            yield node.lineno, node.value


def test_no_message_below_the_command_line_names_a_flag() -> None:
    upper = (SOURCE / "cli", SOURCE / "demo", SOURCE / "lab" / "commands.py")
    files = [path for path in SOURCE.rglob("*.py") if not any(map(path.is_relative_to, upper))]
    assert len(files) > 50
    found = {
        f"{path.relative_to(SOURCE)}:{line}": text
        for path in files
        for line, text in _strings(ast.parse(path.read_text(encoding="utf-8")))
        if re.search(r"(?<![\w-])--[a-z]", QUOTED.sub("", text))
    }
    assert found == {}


class TestWarnings:
    @pytest.fixture
    def warning(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def info(path: Path) -> None:
            for number in (1, 1, 2):
                warnings.warn(f"no. {number}\n`overwrite=True`", KeyssWarning, stacklevel=1)
            raise UsageError("at last")

        monkeypatch.setattr("keyss.runs.describe.info", info)

    @pytest.mark.usefixtures("warning")
    def test_ours_are_a_line_each_once(self, keyss: Run) -> None:
        assert keyss("info", "x").err.splitlines() == [
            "keyss: warning: no. 1 --overwrite",
            "keyss: warning: no. 2 --overwrite",
            "keyss: error: at last",
        ]

    @pytest.mark.usefixtures("warning")
    def test_nothing_of_it_stays(self, keyss: Run) -> None:
        before = warnings.showwarning
        keyss("info", "x")
        assert warnings.showwarning is before
