"""NumPy arrays by the kind of their elements; comments and docstrings give their shapes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from torch import Tensor

Flags = npt.NDArray[np.bool_]
Bits = npt.NDArray[np.uint8]  # each 0 or 1
Bytes = npt.NDArray[np.uint8]
Shorts = npt.NDArray[np.uint16]
Words32 = npt.NDArray[np.uint32]
Words = npt.NDArray[np.uint64]
Integers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Numbers = npt.NDArray[Any]  # any dtype


def doubles(values: Tensor) -> Doubles:
    """A tensor on any device as an array of its shape."""
    return values.detach().cpu().double().numpy()


def frequent(words: Numbers, times: int) -> Numbers:
    """[V] values that occur at least `times` times among `words` [...], in ascending order."""
    ordered, further = np.sort(words, axis=None), times - 1
    return np.unique(ordered[further:][ordered[further:] == ordered[: max(0, len(ordered) - further)]])


def repeated(values: Numbers) -> Flags:
    """Mask [N] of the values [N] that occur at least twice."""
    return among(values, frequent(values, 2))


def among(values: Numbers, ordered: Numbers) -> Flags:
    """Mask [...] of the values [...] that are in `ordered`, in ascending order; faster than `np.isin`."""
    if not len(ordered):
        return np.zeros(values.shape, bool)
    result: Flags = ordered[np.searchsorted(ordered, values).clip(max=len(ordered) - 1)] == values
    return result
