"""One step of Adam on a CPU in one pass over memory, which is what bounds it.

Imports from `rendering.cpu` only: a compiled kernel would outlive a change of other sources, see
`rendering.cpu.jit`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.rendering.cpu import parallel
from keyss.rendering.cpu.jit import kernel
from keyss.rendering.cpu.simd8 import fetch_add

NUMBERS_PER_JOB = 8192

Array = npt.NDArray[np.float32]


@kernel
def _adam(
    counter: Any,
    parameter: Any,
    gradient: Any,
    mean: Any,
    square: Any,
    rates: Any,
    mean_share: Any,
    square_share: Any,
    root: Any,
    eps: Any,
) -> None:
    width = len(rates)
    size = max(1, NUMBERS_PER_JOB // width) * width
    steps = np.empty(size, np.float32)  # the rates of all numbers of a job, for rows are short
    for i in range(size):
        steps[i] = rates[i % width]
    while True:
        first = fetch_add(counter, 0, 1) * size
        if first >= len(parameter):
            break
        p = parameter[first : first + size]
        g = gradient[first : first + size]
        m = mean[first : first + size]
        v = square[first : first + size]
        for i in range(len(p)):
            m[i] += mean_share * (g[i] - m[i])
            v[i] += square_share * (g[i] * g[i] - v[i])
            p[i] -= steps[i] * m[i] / (np.sqrt(v[i]) * root + eps)


def adam(
    parameter: Array,
    gradient: Array,
    mean: Array,
    square: Array,
    rates: Array,
    mean_share: float,
    square_share: float,
    root: float,
    eps: float,
) -> None:
    """Adam's step, in place, on `parameter`, `mean` and `square`; these and `gradient` are flat: [N * W].

    mean += mean_share (gradient - mean), square += square_share (gradient^2 - square), and parameter -=
    rates mean / (root sqrt(square) + eps), with `rates` [W] for the numbers of a row.
    """
    numbers = (np.float32(number) for number in (mean_share, square_share, root, eps))
    parallel.run(_adam, parameter, gradient, mean, square, rates, *numbers)
