"""Peak rate of 8-lane arithmetic on one core, with which the blending is compared."""

from __future__ import annotations

import time
from typing import Any

from keyss.rendering.cpu.jit import finite_kernel
from keyss.rendering.cpu.simd8 import load8, multiply_add, store8

import numpy as np

# Arithmetic on each (Gaussian, pixel) pair, one instruction each: two steps of the recurrence, clamping
# alpha, dimming the transmittance (3), the test whether the pixel has stopped (3), alpha >= 1/255 (2), and
# three colours.
OPERATIONS_PER_PAIR = 14
_ROUNDS = 2_000_000
_CHAINS = 12  # independent operations, enough to hide latencies


def peak_operations() -> float:
    """Vector operations (multiply-adds) per second on one core, the best of several tries."""
    values = np.full(8 * _CHAINS, 0.5, np.float32)
    _multiply_adds(values, 1)
    best = 0.0
    for _ in range(5):
        start = time.perf_counter()
        _multiply_adds(values, _ROUNDS)
        best = max(best, _CHAINS * _ROUNDS / (time.perf_counter() - start))
    return best


@finite_kernel
def _multiply_adds(values: Any, rounds: int) -> None:
    a0, a1, a2, a3 = load8(values, 0), load8(values, 8), load8(values, 16), load8(values, 24)
    b0, b1, b2, b3 = load8(values, 32), load8(values, 40), load8(values, 48), load8(values, 56)
    c0, c1, c2, c3 = load8(values, 64), load8(values, 72), load8(values, 80), load8(values, 88)
    for _ in range(rounds):
        a0 = multiply_add(a0, a0, a0)
        a1 = multiply_add(a1, a1, a1)
        a2 = multiply_add(a2, a2, a2)
        a3 = multiply_add(a3, a3, a3)
        b0 = multiply_add(b0, b0, b0)
        b1 = multiply_add(b1, b1, b1)
        b2 = multiply_add(b2, b2, b2)
        b3 = multiply_add(b3, b3, b3)
        c0 = multiply_add(c0, c0, c0)
        c1 = multiply_add(c1, c1, c1)
        c2 = multiply_add(c2, c2, c2)
        c3 = multiply_add(c3, c3, c3)
    store8(values, 0, a0 + a1 + a2 + a3)
    store8(values, 8, b0 + b1 + b2 + b3)
    store8(values, 16, c0 + c1 + c2 + c3)
