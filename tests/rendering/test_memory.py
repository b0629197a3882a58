"""Memory for the kernels is recycled, never shared, and bounded."""

from __future__ import annotations

import gc
import sys

import numpy as np
import pytest

from keyss.kernels import memory
from rendering.child_process import python


@pytest.fixture(autouse=True)
def _nothing_free(monkeypatch: pytest.MonkeyPatch) -> None:
    gc.collect()
    monkeypatch.setattr(memory, "_free", {})


def test_buffers_are_reused_when_freed() -> None:
    first = memory.empty((1000, 100), np.float32)
    address = first.ctypes.data
    assert address % 64 == 0
    view = first[10:].reshape(-1)
    del first
    other = memory.empty((1000, 100), np.float32)
    assert not np.shares_memory(other, view)
    del view
    again = memory.empty((1000, 90), np.int32)
    assert again.ctypes.data == address
    assert again.shape == (1000, 90)
    assert again.dtype == np.int32


# A million Gaussians as in fitted scenes, nearly all of them visible. A few are drawn before, so that what
# the compiler takes is not counted.
DRAW_A_MILLION = """
import math, resource, torch
from keyss.rendering import rasterization

def draw(count, width, height):
    generator = torch.Generator().manual_seed(0)
    def normal(*shape):
        return torch.randn(*shape, generator=generator)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4
    K = torch.tensor([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1]])
    scales = (math.log(0.42 * count ** (-1 / 3)) + 0.5 * normal(count, 3)).exp()
    inputs = [normal(count, 3), normal(count, 4), scales, normal(count).mul(1.5).sigmoid()]
    inputs.append(0.2 * normal(count, 16, 3))
    inputs = [tensor.requires_grad_() for tensor in inputs]
    with open("/proc/self/statm") as file:
        before = int(file.read().split()[1]) * resource.getpagesize()
    images, _, meta = rasterization(*inputs, viewmat[None], K[None], width, height, sh_degree=3)
    images.sum().backward()
    assert (meta["radii"] > 0).all(-1).sum() > 0.5 * count
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before

draw(100, 64, 64)
print(draw(1_000_000, 1600, 1066))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_peak_memory() -> None:
    done = python(DRAW_A_MILLION)
    assert done.returncode == 0, done.stderr
    growth = int(done.stdout)
    print(f"peak resident memory grew by {growth / 2**30:.2f} GiB")
    assert growth <= 4 * 2**30
