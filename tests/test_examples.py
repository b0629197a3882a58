"""The notebooks, the custom design in examples/ and the example in the README run."""

from __future__ import annotations

import re
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from files.scene_files import write_blender, write_nerfstudio
from keyss.methods import open_model
from methods.hiding import hide_scenes, three_scenes
from methods.keyss.small import FIT

NOTEBOOKS = sorted((Path(__file__).parents[1] / "examples").glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Jupyter's own
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    nbclient, nbformat = map(pytest.importorskip, ("nbclient", "nbformat"))
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]


@pytest.mark.filterwarnings("ignore:density control added no")
def test_custom_design() -> None:
    path = Path(__file__).parents[1] / "examples" / "own_design.py"
    assert len(path.read_text().splitlines()) <= 30
    example: dict[str, Any] = runpy.run_path(str(path))
    options = example["KeyssOptions"](fit=replace(FIT, iterations=10), design=example["DESIGN"])
    scenes, models = three_scenes()
    stego = hide_scenes(scenes[:2], ["a key"], options, plains=models[:2]).stego
    opened = open_model(stego, "a key")
    decoded = opened.decode(stego, opened.key)  # type: ignore[misc,attr-defined]
    own = stego[: len(decoded)]
    assert torch.equal(decoded.means, own.means)
    assert not torch.equal(decoded.opacity_logits, own.opacity_logits)


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
