"""Completion in bash."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from cli.harness import COMMANDS, Run
from keyss.fitting import PRESETS


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("completion") / "keyss.bash"


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (["keyss", ""], {*COMMANDS, "-h", "--help"}),
        (["keyss", "re"], {"reveal", "render", "reproduce"}),
        (["keyss", "hide", "--secret"], {"--secret", "--secret-file", "--secret-model"}),
        (["keyss", "hide", "--min"], {"--min-psnr"}),
        (["keyss", "fit", "x", "--preset", ""], set(PRESETS)),
    ],
)
def test_bash_completion(keyss: Run, script: Path, words: list[str], completed: set[str]) -> None:
    if not script.exists():
        result = keyss("--completion", "bash")
        assert (result.status, result.err) == (0, "")
        script.write_text(result.out)
    line = (
        'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _tyro_keyss; echo "${COMPREPLY[@]}"'
    )
    command = ["bash", "-c", line, "bash", str(script), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert set(done.stdout.split()) == completed
