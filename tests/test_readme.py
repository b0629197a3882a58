"""The Python example in the README runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from files.scene_files import write_blender, write_nerfstudio

README = (Path(__file__).parents[1] / "README.md").read_text()
SHORT = 'method=keyss.CarryOptions(publish="converted").with_fit(iterations=10, max_gaussians=100), '


def test_python_example(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(example.splitlines()) <= 10
    short = "import keyss\n" + example.replace('preset="quick", ', SHORT)
    assert SHORT in short
    write_blender(tmp_path / "out" / "demo" / "scenes" / "tea-table", count=2)
    write_nerfstudio(tmp_path / "out" / "demo" / "scenes" / "golden-knot")
    monkeypatch.chdir(tmp_path)
    exec(compile(short, "README.md", "exec"), {})
    assert "100 Gaussians" in capsys.readouterr().out
    assert (tmp_path / "secret.ply").exists()
