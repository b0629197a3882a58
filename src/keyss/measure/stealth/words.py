"""A model's floats as an attacker sees them: bit patterns by field, attribute and magnitude."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from keyss.core.gaussians import Gaussians

ATTRIBUTES = ("position", "scale", "rotation", "opacity", "colour", "sh1", "sh2", "sh3")
MANTISSA = 23
# Numbers by binary exponent: what was much larger once keeps the grid of that, so that small ones tell most.
MAGNITUDES = {"tiny": (-126, -15), "small": (-15, -13), "middling": (-13, -9), "large": (-9, 128)}
# A number with so many zeros at its end is a short one, not a trained one; embedding leaves those alone.
_SHORT = np.uint32((1 << 20) - 1)

Floats = npt.NDArray[np.float64]
Bits = npt.NDArray[np.uint32]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Words:
    """The floats of N Gaussians as bit patterns, F to each."""

    bits: Bits  # [N, F]
    attribute: Ints  # [F] index into ATTRIBUTES

    @staticmethod
    def of(model: Gaussians) -> Words:
        fields = [model.means, model.log_scales, model.quats, model.opacity_logits[:, None]]
        fields += [model.sh[:, band**2 : (band + 1) ** 2].flatten(1) for band in range(model.sh_degree + 1)]
        parts = [each.detach().cpu().float().contiguous().numpy().view(np.uint32) for each in fields]
        attribute = np.repeat(np.arange(len(parts)), [part.shape[1] for part in parts])
        return Words(np.concatenate(parts, axis=1), attribute)

    @cached_property
    def exponent(self) -> Ints:
        """[N, F] binary exponents, -127 for zero."""
        return (self.bits >> MANTISSA & 255).astype(np.int64) - 127

    @cached_property
    def trained(self) -> Flags:
        """[N, F] which numbers are not short ones."""
        found: Flags = (self.bits & _SHORT) != 0
        return found

    def of_attribute(self, index: int) -> slice:
        """Columns."""
        columns = np.flatnonzero(self.attribute == index)
        return slice(int(columns[0]), int(columns[-1]) + 1) if len(columns) else slice(0, 0)


def ulps(one: Bits, other: Bits) -> Ints:
    """How many steps of the last bit lie between numbers; the far end of the integers where signs differ."""
    a, b = (each & 0x7FFFFFFF for each in (one, other))
    apart = np.abs(a.astype(np.int64) - b.astype(np.int64))
    return np.where((one ^ other) >> 31 == 0, apart, np.int64(1) << 31)
