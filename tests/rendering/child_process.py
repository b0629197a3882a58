"""Functions that tests run in child processes, importable without pytest."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import torch

import keyss  # before torch starts its threads: see keyss._threads
from rendering.scenes import Scene, random_scene


def digest(scene: Scene) -> str:
    """SHA-256 of the results of the forward and backward pass."""
    found = hashlib.sha256()
    for tensor in scene.results().values():
        found.update(tensor.contiguous().numpy().tobytes())
    return found.hexdigest()


def digest_on_threads(threads: int) -> str:
    """The digest of a random scene rendered on `threads` threads."""
    torch.set_num_threads(threads)
    return digest(random_scene(count=300, width=60, height=70))


SOURCE = Path(keyss.__file__).parents[1]


def python(code: str, source: Path = SOURCE, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python code that imports keyss from `source`."""
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(source), **environment},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
