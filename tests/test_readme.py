"""What the README shows works."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from files.scene_files import write_blender, write_nerfstudio
from keyss.methods.learned.options import PRESETS as LEARNED_PRESETS

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_the_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(example.splitlines()) <= 28
    short = example.replace("max_gaussians=20_000", "max_gaussians=100, iterations=10")
    assert short != example
    short = short.replace("LearnedOptions()", 'LearnedOptions(publish="any")')  # so small a model has no room
    assert "any" in short
    write_blender(tmp_path / "scenes" / "bonsai", count=2)
    write_nerfstudio(tmp_path / "scenes" / "fox")
    monkeypatch.chdir(tmp_path)
    exec(compile(short, "README.md", "exec"), {})
    key = (tmp_path / "key.txt").read_text()
    exec(compile(short, "README.md", "exec"), {})  # once more: it keeps its key and replaces its results
    assert (tmp_path / "key.txt").read_text() == key
    assert "100 Gaussians" in capsys.readouterr().out
    assert (tmp_path / "secret.ply").exists()


def test_the_sizes_of_presets_are_those_there_are() -> None:
    """Each stands there with its name, steps and Gaussians."""
    text = " ".join(README.split())
    for name in ("best", "quick", "paper"):
        fit = LEARNED_PRESETS[name].fit
        found = re.search(rf"`{name}`[^;]*? ([\d,]+)(?: steps)? and (?:at most )?([\d,]+)", text)
        assert found is not None, name
        assert found.groups() == (f"{fit.iterations:,}", f"{fit.max_gaussians:,}"), name


def test_the_files_it_links_to_exist() -> None:
    root = Path(__file__).parents[1]
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", README) if "://" not in link]
    assert links
    assert [link for link in links if not (root / link).exists()] == []
