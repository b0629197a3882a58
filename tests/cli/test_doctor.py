"""`keyss doctor` on working and broken installations."""

from __future__ import annotations

import re
from importlib import metadata
from typing import Any

import pytest
import torch
from torch import Tensor

from cli.harness import Result, Run
from keyss import __version__, rendering
from keyss.core import Camera, Gaussians


def states(result: Result) -> dict[str, str]:
    lines = (re.split("  +", line) for line in result.out.splitlines())
    return {name: state for state, name, _ in lines}


def test_working_installation(keyss: Run) -> None:
    result = keyss("doctor", "--device", "cpu")
    assert (result.status, result.err) == (0, "")
    assert re.search(rf"^ok +keyss +{re.escape(__version__)}, ", result.out, re.MULTILINE)
    assert re.search(rf"^ok +torch +{re.escape(torch.__version__)}$", result.out, re.MULTILINE)
    assert states(result)["test frame"] == "ok"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA GPU")
def test_missing_device(keyss: Run) -> None:
    result = keyss("doctor", "--device", "cuda")
    assert result.status == 6
    assert states(result)["test frame"] == "broken"
    assert "keyss: error: required components are broken: test frame" in result.err


@pytest.mark.parametrize(("where", "factor"), [("middle", 0.999), ("corner", 0.0)])
def test_wrong_render(keyss: Run, monkeypatch: pytest.MonkeyPatch, where: str, factor: float) -> None:
    real = rendering.render

    def wrong(model: Gaussians, camera: Camera, **options: Any) -> Tensor:
        image = real(model, camera, **options)
        if where == "corner":
            image[0, 0] = 0.01
        return image * (factor or 1)

    monkeypatch.setattr("keyss.rendering.render", wrong)
    result = keyss("doctor", "--device", "cpu")
    assert result.status == 6
    assert [name for name, state in states(result).items() if state == "broken"] == ["test frame"]


def test_missing_packages(keyss: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = {"ray", "numba"}
    version = metadata.version

    def installed(name: str) -> str:
        if name in gone:
            raise metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(metadata, "version", installed)
    result = keyss("doctor", "--device", "cpu")
    assert result.status == 6
    assert re.search(r"^missing +\[sweep\] .*pip install 'keyss\[sweep\]'$", result.out, re.MULTILINE)
    assert re.search(r"^broken +numba +PackageNotFoundError: ", result.out, re.MULTILINE)
    assert result.err.count("\n") == 1
