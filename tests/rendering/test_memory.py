"""Peak memory of the CPU rasterizer."""

from __future__ import annotations

import sys

import pytest

from rendering.child_process import python

# A million Gaussians as in fitted scenes, most of them visible. A small scene is drawn first, so that memory
# of the compiler does not count.
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
    image, _, meta = rasterization(*inputs, viewmat, K, width, height, sh_degree=3)
    image.sum().backward()
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
