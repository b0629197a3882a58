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
