"""The floats of a model as bit patterns, by field, attribute and magnitude."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from torch import Tensor

from keyss.core.gaussians import Gaussians

ATTRIBUTES = ("position", "scale", "rotation", "opacity", "colour", "sh1", "sh2", "sh3")
MANTISSA = 23
# By binary exponent. A number keeps the grid of its largest value in training, so small ones tell most.
MAGNITUDES = {"tiny": (-126, -15), "small": (-15, -13), "middling": (-13, -9), "large": (-9, 128)}
# A number that ends in this many zeros was not trained; embedding does not change it.
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
        """[N, F] True for numbers that are not short: see _SHORT."""
        result: Flags = (self.bits & _SHORT) != 0
        return result

    def of_attribute(self, index: int) -> slice:
        """Columns."""
        columns = np.flatnonzero(self.attribute == index)
        return slice(int(columns[0]), int(columns[-1]) + 1) if len(columns) else slice(0, 0)


def doubles(values: Tensor) -> Floats:
    """A tensor as float64 on the CPU."""
    result: Floats = values.detach().cpu().double().numpy()
    return result


def ulps(one: Bits, other: Bits) -> Ints:
    """Steps of the last bit between numbers; 2^31 if their signs differ."""
    a, b = (each & 0x7FFFFFFF for each in (one, other))
    apart = np.abs(a.astype(np.int64) - b.astype(np.int64))
    return np.where((one ^ other) >> 31 == 0, apart, np.int64(1) << 31)
