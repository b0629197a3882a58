"""What tests run in processes of their own: importable there without pytest."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import torch

import keyss  # noqa: F401  before torch starts its threads: see keyss._threads
from rendering.scenes import Scene, random_scene


def digest(scene: Scene) -> str:
    """A hash of everything that drawing the scene and going back gives, bit by bit."""
    found = hashlib.sha256()
    for tensor in scene.results().values():
        found.update(tensor.contiguous().numpy().tobytes())
    return found.hexdigest()


def digest_on_threads(threads: int) -> str:
    """That of one random scene."""
    torch.set_num_threads(threads)
    return digest(random_scene(count=300, width=60, height=70))


def check_on_generic_processor(names: Sequence[str]) -> str:
    """Holds scenes to the dense reference; returns for which processor, without extras, the kernels are."""
    from numba.core.registry import cpu_target

    from rendering.scenes import SCENES
    from rendering.test_against_dense_reference import check

    for name in names:
        check(SCENES[name]())
    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    return f"{processor} {features}".strip()
