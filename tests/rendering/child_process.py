"""Code that tests run in child processes, importable without pytest."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

import keyss  # before torch starts its threads: see keyss._threads
from rendering.scenes import Scene, random_scene


def digest(scene: Scene) -> str:
    """A hash of all bits of the results of forward and backward pass."""
    found = hashlib.sha256()
    for tensor in scene.results().values():
        found.update(tensor.contiguous().numpy().tobytes())
    return found.hexdigest()


def digest_on_threads(threads: int) -> str:
    """The digest of a random scene on so many threads."""
    torch.set_num_threads(threads)
    return digest(random_scene(count=300, width=60, height=70))


def check_on_generic_processor(names: Sequence[str]) -> str:
    """Check scenes against the dense reference; returns the processor that the kernels are compiled for."""
    from numba.core.registry import cpu_target

    from rendering.scenes import SCENES
    from rendering.test_against_dense_reference import check

    for name in names:
        check(SCENES[name]())
    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    return f"{processor} {features}".strip()


SOURCE = Path(keyss.__file__).parents[1]


def python(code: str, source: Path = SOURCE, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code that imports keyss from a folder."""
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(source), **environment},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
