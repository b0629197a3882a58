"""How well a classifier tells embedded models from ordinary ones, on models that you have.

    python benchmarks/steganalysis.py bonsai=runs/a/model.ply bonsai=runs/b/model.ply fox=runs/c/model.ply ...
    python benchmarks/steganalysis.py --carry bonsai=...     # each carries a part of the next instead

Each model is cut into up to four spatially disjoint parts of at least 1,000 Gaussians, and each part is
embedded into. The classifiers learn from all scenes but one and are tried on that one; a scene is the name
before the `=`, and there must be three or more.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from keyss.carry import carrying
from keyss.files.ply import read_ply
from keyss.seal import DerivedKey
from keyss.seal.container import embed_derived
from keyss.seal.plan import SALTS
from seal.steganalysis import features, held_out_auc, parts


def main(arguments: list[str]) -> None:
    carried = "--carry" in arguments
    arguments = [argument for argument in arguments if argument != "--carry"]
    plain, embedded, scenes = [], [], []
    secret = read_ply(arguments[-1].split("=", 1)[1])
    for argument in arguments:
        scene, path = argument.split("=", 1)
        model = read_ply(path)
        for part in parts(model, min(2, int(np.log2(len(model) / 1000)))):
            keys = [DerivedKey.of_master(os.urandom(32)) for _ in range(SALTS)]
            plain.append(features(part))
            if carried:
                stego = carrying.embed_derived(part, [(keys, secret[: len(part)])])
            else:
                stego = embed_derived(part, [(keys, os.urandom(800))])
            embedded.append(features(stego))
            scenes.append(scene)
        secret = model
    numbers = np.unique(scenes, return_inverse=True)[1]
    count = len(scenes)
    pairs = held_out_auc(np.array(plain + embedded), np.repeat([0, 1], count), np.tile(numbers, 2))
    print(f"{len(arguments)} models, {count} parts, each plain and embedded: {pairs}")
    runs = []
    for seed in range(6):
        chosen = np.random.default_rng(seed).permutation(np.arange(count) % 2)
        x = np.where(chosen[:, None] == 1, embedded, plain)
        runs.append(held_out_auc(x, chosen, numbers))
    means = {name: float(np.mean([run[name] for run in runs])) for name in runs[0]}
    print(f"every part either plain or embedded, mean of {len(runs)} draws: {means}")


if __name__ == "__main__":
    main(sys.argv[1:])
