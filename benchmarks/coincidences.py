"""Equal low bits of Gaussians whose high bits agree, in plain models and after embedding.

python benchmarks/coincidences.py bonsai.ply fox.ply ...
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import keyss  # noqa: F401  before torch, see `ruff.toml`
from keyss.files import read_model

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from channels.quiet.payloads import embed_derived
from channels.quiet.trained_like import keys
from keyss.lab.stealth.agreement import count_coincidences
from keyss.lab.stealth.statistic import BitPatterns


def main(paths: list[str]) -> None:
    equal: Counter[tuple[str, str]] = Counter()
    agreeing: Counter[str] = Counter()
    chance: Counter[str] = Counter()
    for path in paths:
        plain = read_model(path)
        for kind, model in (("plain", plain), ("embedded", embed_derived(plain, [(keys(), bytes(4000))]))):
            for name, (same, pairs, bits) in count_coincidences(model, BitPatterns.of(model)).items():
                equal[name, kind] += same
                if kind == "plain":
                    agreeing[name] += pairs
                    chance[name] += pairs / 2**bits  # type: ignore[assignment]
    print("| pairs | agree in high bits | equal before | after | by chance |")
    print("| --- | --- | --- | --- | --- |")
    for name, pairs in agreeing.items():
        before, after = equal[name, "plain"], equal[name, "embedded"]
        print(f"| {name} | {pairs:,} | {before:,} | {after:,} | {chance[name]:,.1f} |")


if __name__ == "__main__":
    main(sys.argv[1:])
