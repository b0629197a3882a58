"""The notebooks and the custom design in examples/ run."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from keyss.methods import DECODERS, open_model
from methods.hiding import hide_scenes, three_scenes
from methods.keyss.small import FIT

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")

NOTEBOOKS = sorted((Path(__file__).parents[1] / "examples").glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Jupyter's own
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    # As in pyproject.toml.
    monkeypatch.setenv("PYTHONWARNINGS", "ignore:the first salt of this model cannot be renewed")
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]


def test_custom_design(monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(__file__).parents[1] / "examples" / "own_design.py"
    assert len(path.read_text().splitlines()) <= 40
    monkeypatch.setitem(DECODERS, "bounded", DECODERS["mlp"])  # removed again after the test
    example: dict[str, Any] = runpy.run_path(str(path))
    design = replace(example["DESIGN"], decoder_rate=1e-2)
    options = example["KeyssOptions"](fit=replace(FIT, iterations=10), design=design)
    scenes, models = three_scenes()
    stego = hide_scenes(scenes[:2], ["a key"], options, plains=models[:2]).stego
    opened = open_model(stego, "a key")
    decoded = opened.decode(stego, opened.key)  # type: ignore[misc,attr-defined]
    moved = (decoded.means - stego[: len(decoded)].means).abs()
    assert type(opened.decoder).__name__ == "BoundedDecoder"  # type: ignore[attr-defined]
    assert 0 < float(moved.max()) <= example["REACH"] + 1e-6
    assert torch.isfinite(decoded.means).all()
