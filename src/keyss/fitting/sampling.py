"""Random order of training views: every view once per epoch, shuffled, resumable."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


@contextmanager
def own_randomness(seed: int) -> Iterator[None]:
    """Seed torch's global generators, on the CPU and the current GPU, and restore them after the block."""
    gpus = [torch.cuda.current_device()] if torch.cuda.is_available() else []
    with torch.random.fork_rng(gpus):
        torch.manual_seed(seed)
        yield


class Shuffle:
    """Samples 0..count-1 without replacement, over and over."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.count = count
        self.generator = generator
        self.remaining = torch.empty(0, dtype=torch.int64)

    def sample(self) -> int:
        if len(self.remaining) == 0:
            self.remaining = torch.randperm(self.count, generator=self.generator)
        index = int(self.remaining[-1])
        self.remaining = self.remaining[:-1]
        return index

    def state(self) -> Tensor:
        return self.remaining.clone()

    def load(self, state: Tensor) -> None:
        self.remaining = state
