"""The fountain code of the channel `colours` against Reed-Solomon codewords at equal losses.

python benchmarks/colours_code.py [--gaussians N]

Some Gaussians are lost, and some of the others hold random bits, which the reader does not know. For Reed-
Solomon, a hash of its name gives each Gaussian a place in a codeword, bits in one place are added up softly,
and the chunks that are least likely right are left out; of several lengths, the best one counts. For each
code: the largest payload that came back in all of six trials.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from keyss.channels import Codewords, Fountain
from keyss.core import InputError

import numpy as np

TRIALS = 6
SYMBOL = 16  # bits
MEANS = (1.5, 2, 3, 4, 5, 7, 10, 14, 20, 28)  # Gaussians for each place
CHANNELS = ((0.25, 0.04), (0.5, 0.04), (0.25, 0.3), (0.0, 0.5))  # lost, holding something else

Code = Callable[[int, np.random.Generator], bool]  # whether so many random bytes come back


def _received(
    bits: np.ndarray, lost: float, other: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Which Gaussians [G] are left, and P(0) - P(1) of their bits [G, b]."""
    garbled = np.where(random.random((len(bits), 1)) < other, random.integers(0, 2, bits.shape), bits)
    return random.random(len(bits)) >= lost, (1 - other) * 0.99 * (1 - 2.0 * garbled)


def fountain(gaussians: int, bits: int, lost: float, other: float) -> Code:
    def comes_back(size: int, random: np.random.Generator) -> bool:
        data, code = random.integers(0, 2, 8 * size).astype(np.uint8), Fountain(8 * size)
        seeds = random.integers(0, 2**63, (gaussians, bits)).astype(np.uint64)
        left, hints = _received(code.encode(data, seeds.ravel()).reshape(seeds.shape), lost, other, random)
        return np.array_equal(code.decode(seeds[left].ravel(), hints[left].ravel()), data)

    return comes_back


def reed_solomon(gaussians: int, bits: int, lost: float, other: float, mean: float) -> Code:
    chunks = int(gaussians / mean * bits / SYMBOL)

    def comes_back(size: int, random: np.random.Generator) -> bool:
        count = -(-chunks // 8192)
        n, k = chunks // count, -(-size // 2 // count)
        if not 1 <= k <= n:
            return False
        codewords, data = Codewords(count, n, k, SYMBOL // 8), random.bytes(size)
        code = np.unpackbits(codewords.encode(data).ravel()).reshape(-1, bits)
        place = random.integers(0, len(code), gaussians)
        left, hints = _received(code[place], lost, other, random)
        ratios = np.zeros(code.shape)
        np.add.at(ratios, place[left], 2 * np.arctanh(hints[left]))
        ratios = ratios.reshape(-1, SYMBOL)
        likely = np.flatnonzero((1 / (1 + np.exp(-np.abs(ratios)))).prod(axis=1) > 0.5)
        found = np.packbits((ratios[likely] < 0).astype(np.uint8), axis=1)
        try:
            return codewords.decode(likely, found, errors=True)[:size] == data
        except InputError:
            return False

    return comes_back


def largest(code: Code, most: int) -> int:
    """The largest even number of bytes, to 2 %, that came back in all trials."""
    low, high = 0, most
    while high - low > max(2, high // 50):
        middle = (low + high) // 4 * 2
        if middle <= low:
            break
        good = all(code(middle, np.random.default_rng(trial)) for trial in range(TRIALS))
        low, high = (middle, high) if good else (low, middle)
    return low


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=8000)
    count = parser.parse_args().gaussians
    print("| bits of a Gaussian | lost | other | fountain, bytes | Reed-Solomon, bytes | ratio |")
    print("| --- | --- | --- | --- | --- | --- |")
    for bits in (2, 8):
        for lost, other in CHANNELS:
            own = largest(fountain(count, bits, lost, other), count * bits // 8)
            every = [reed_solomon(count, bits, lost, other, mean) for mean in MEANS]
            best = max(largest(code, count * bits // 8) for code in every)
            row = f"| {bits} | {lost:.0%} | {other:.0%} | {own:,} | {best:,} | {best / max(1, own):.2f} |"
            print(row, flush=True)


if __name__ == "__main__":
    main()
