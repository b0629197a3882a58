"""Code that tests run in child processes, importable without pytest."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import torch

import keyss  # noqa: F401  before torch starts its threads: see keyss._threads
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
