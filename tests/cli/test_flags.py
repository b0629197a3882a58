"""On the command line, messages name flags instead of Python arguments."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

from cli.harness import Run
from keyss.cli import entry
from keyss.core import KeyssWarning, UsageError

OPTIONS = {"overwrite", "max_gaussians", "key_file", "secret", "publish", "secret_model", "download"}


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("`overwrite=True` replaces it", "--overwrite replaces it"),
        ('`method="keyss"` can', "--method keyss can"),
        ('`method="carry", overwrite=True` has one', "--method carry --overwrite has one"),
        ("`max_gaussians=30000` would do", "--max-gaussians 30000 would do"),
        ("`min_psnr=12.5`", "--min-psnr 12.5"),
        ("give `max_gaussians`, `publish`", "give --max-gaussians, --publish"),
        ("`key`, `secrets` and `model`", "--key-file, --secret and --secret-model"),
        # Other code stays as it is.
        ("`chmod 600` and `f_dc_0` and `reporter`", "`chmod 600` and `f_dc_0` and `reporter`"),
        ("`keyss keygen -o FILE`", "`keyss keygen -o FILE`"),
        ("x=`; overwrite=True", "x=`; overwrite=True"),
    ],
)
def test_argument_names_become_flags(message: str, expected: str) -> None:
    assert entry.as_flags(message, OPTIONS) == expected


def test_repeated_warnings_print_once(keyss: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def info(path: Path, *, capacity: bool) -> None:
        for number in (1, 1, 2):
            warnings.warn(f"no. {number}\n`overwrite=True`", KeyssWarning, stacklevel=1)
        raise UsageError("at last")

    monkeypatch.setattr("keyss.runs.describe.info", info)
    assert keyss("info", "x").err.splitlines() == [
        "keyss: warning: no. 1 --overwrite",
        "keyss: warning: no. 2 --overwrite",
        "keyss: error: at last",
    ]
