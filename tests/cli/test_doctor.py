"""What `keyss doctor` finds, and that it notices what does not work."""

from __future__ import annotations

import json
import re
from importlib import metadata
from typing import Any

import pytest
import torch
from torch import Tensor

from cli.said import Run, Said
from keyss import __version__, rendering
from keyss.core import Camera, Gaussians


def states(said: Said) -> dict[str, str]:
    return {name: each["state"] for name, each in json.loads(said.out).items()}


def test_a_sound_installation(keyss: Run) -> None:
    said = keyss("doctor", "--device", "cpu")
    assert (said.status, said.err) == (0, "")
    lines = {line.split()[1]: line for line in said.out.splitlines()}
    assert __version__ in lines["keyss"]
    assert torch.__version__ in lines["torch"]
    assert lines["test"].startswith("ok ")
    found = states(keyss("doctor", "--device", "cpu", "--json"))
    assert list(found.values()) == [line.split()[0] for line in said.out.splitlines()]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA GPU")
def test_a_device_that_is_not_there(keyss: Run) -> None:
    said = keyss("doctor", "--device", "cuda", "--json")
    assert said.status == 6
    assert states(said)["test frame"] == "broken"
    assert "keyss: error: required components are broken: test frame" in said.err


@pytest.mark.parametrize(("where", "factor"), [("middle", 0.999), ("corner", 0.0)])
def test_a_picture_that_is_wrong(
    keyss: Run, monkeypatch: pytest.MonkeyPatch, where: str, factor: float
) -> None:
    real = rendering.render

    def wrong(model: Gaussians, camera: Camera, **options: Any) -> Tensor:
        image = real(model, camera, **options)
        if where == "corner":
            image[0, 0] = 0.01
        return image * (factor or 1)

    monkeypatch.setattr("keyss.rendering.render", wrong)
    said = keyss("doctor", "--device", "cpu", "--json")
    assert said.status == 6
    assert [name for name, state in states(said).items() if state == "broken"] == ["test frame"]


def test_what_is_missing_and_how_to_get_it(keyss: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = {"av", "numba"}
    version = metadata.version

    def installed(name: str) -> str:
        if name in gone:
            raise metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(metadata, "version", installed)
    said = keyss("doctor", "--device", "cpu")
    assert said.status == 6
    assert re.search(r"^missing +\[video\] .*pip install 'keyss\[video\]'$", said.out, re.MULTILINE)
    assert re.search(r"^broken +numba +pip install numba$", said.out, re.MULTILINE)
    assert said.err.count("\n") == 1
