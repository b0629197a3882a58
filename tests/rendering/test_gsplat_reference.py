"""What a GPU is given and gives back, without one: gsplat computes by its own reference implementation.

Only the kernels themselves and the driver are left to `make test-cuda`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import torch

from rendering.gsplat_reference import COMPILED, NERFACC
from rendering.pretended_cuda import pretended_gpu
from rendering.scenes import SCENES
from rendering.test_cuda import check_backends_agree


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C=COMPILED))
    monkeypatch.setitem(sys.modules, "nerfacc", NERFACC)
    monkeypatch.setattr("keyss.rendering.rasterize.require_gsplat_cuda", lambda: None)
    monkeypatch.setattr("keyss.rendering.backends.require_gsplat_cuda", lambda: None)
    with pretended_gpu() as device:
        yield device


@pytest.mark.parametrize("name", SCENES)
def test_backends_agree(name: str, gpu: torch.device) -> None:
    check_backends_agree(SCENES[name](), gpu)
