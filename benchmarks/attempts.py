"""Times of right and wrong keys: medians of alternating attempts.

    python benchmarks/attempts.py [--gaussians 20000] [--rounds 21]

"open" is everything up to the unpacked secret or the refusal, "reveal" is `keyss reveal --decoy` with its
files. The noise compares the right key with itself: every other attempt with the rest. On a busy machine it
exceeds the difference; processor time is less noisy.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import keyss
from channels.quiet.trained_like import trained_like
from keyss.channels import APPENDED, LOW_BITS
from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.files.models import write_model
from keyss.keys import generate_key, random_embeddings
from keyss.methods import Decoder, DecoderShape, KeyssSecret, choose_anchors, open_model

import torch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=21)
    asked = parser.parse_args()
    right, wrong = generate_key(), generate_key()
    plain = trained_like(asked.gaussians)
    generator = torch.Generator().manual_seed(0)
    decoder = Decoder(DecoderShape(mask=("op",))).requires_grad_(False)
    key = random_embeddings(1, generator)[0]
    secret = KeyssSecret(decoder, key, Similarity(), choose_anchors(plain, 0))
    contents = [(right, secret.payload())]
    files = {
        "low bits": LOW_BITS.prepare(plain).embed(contents),
        "appended": APPENDED.prepare(plain).embed(contents),
    }
    print(f"{asked.gaussians:,} Gaussians, {asked.rounds} attempts of each kind")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stego.ply"
        for name, stego in files.items():
            write_model(path, stego)
            _compare(
                f"open, {name}", lambda key, stego=stego: _attempt(stego, key), right, wrong, asked.rounds
            )
            _compare(
                f"reveal --decoy, {name}",
                lambda key: keyss.reveal(path, key, decoy=True, out=Path(folder) / "out.ply", overwrite=True),
                right,
                wrong,
                asked.rounds,
            )


def _attempt(stego: Gaussians, key: str) -> None:
    with suppress(WrongKeyError):
        open_model(stego, key)


def _compare(name: str, attempt: Callable[[str], object], right: str, wrong: str, rounds: int) -> None:
    attempt(right)
    attempt(wrong)
    for clock, seconds in (("by the clock", time.perf_counter), ("of the processor", time.process_time)):
        taken: dict[str, list[float]] = {right: [], wrong: []}
        for number in range(rounds):
            for key in (right, wrong) if number % 2 else (wrong, right):
                start = seconds()
                attempt(key)
                taken[key].append(seconds() - start)
        a, b = (statistics.median(taken[key]) for key in (right, wrong))
        noise = statistics.median(taken[right][::2]) / statistics.median(taken[right][1::2]) - 1
        print(f"{name}, {clock}: right {a:.3f} s, wrong {b:.3f} s ({b / a - 1:+.1%}; noise {noise:+.1%})")


if __name__ == "__main__":
    main()
