"""A stand-in for an opened secret."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from keyss.core import Gaussians, Similarity


@dataclass(frozen=True)
class Whole:
    """A `HiddenScene` with a known model."""

    gaussians: Gaussians
    frame: Similarity | None = None

    def reveal(self, stego: Gaussians, **_: Any) -> Gaussians:
        return self.gaussians
