"""The order in which training views are drawn: every view once per epoch, shuffled, resumable."""

from __future__ import annotations

import torch
from torch import Tensor


class Shuffle:
    """Draws 0..count-1 without replacement, over and over."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.count = count
        self.generator = generator
        self.remaining = torch.empty(0, dtype=torch.int64)

    def draw(self) -> int:
        if len(self.remaining) == 0:
            self.remaining = torch.randperm(self.count, generator=self.generator)
        index = int(self.remaining[-1])
        self.remaining = self.remaining[:-1]
        return index

    def state(self) -> Tensor:
        return self.remaining.clone()

    def load(self, state: Tensor) -> None:
        self.remaining = state
