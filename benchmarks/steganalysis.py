"""How well a classifier tells embedded models from ordinary ones, on models that you have.

    python benchmarks/steganalysis.py bonsai=runs/a/model.ply bonsai=runs/b/model.ply fox=runs/c/model.ply ...
    python benchmarks/steganalysis.py --carry bonsai=...     # each carries half as many of the next

Each model is cut into up to four spatially disjoint parts of at least 1,000 Gaussians, and each part is
embedded into. The classifiers learn from all scenes but one and are tried on that one; a scene is the name
before the `=`, and there must be three or more. Standard errors are bootstrapped over whole models.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
from sklearn.metrics import roc_auc_score

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from channels.low_bits.payloads import embed_derived
from channels.low_bits.steganalysis import features, held_out_scores, parts, standard_error
from keyss.channels.low_bits.layout import SALTS
from keyss.files.models import read_model
from keyss.keys import DerivedKey
from methods.carry import carried as carrying

Labels = npt.NDArray[np.int64]


def main(arguments: list[str]) -> None:
    carried = "--carry" in arguments
    arguments = [argument for argument in arguments if argument != "--carry"]
    plain, embedded, scenes, models = [], [], [], []
    secret = read_model(arguments[-1].split("=", 1)[1])
    for model, argument in enumerate(arguments):
        scene, path = argument.split("=", 1)
        whole = read_model(path)
        for part in parts(whole, min(2, int(np.log2(len(whole) / 1000)))):
            keys = [DerivedKey.of_master(os.urandom(32)) for _ in range(SALTS)]
            plain.append(features(part))
            if carried:
                stego = carrying.embed_derived(part, [(keys, secret[: len(part) // 2])])
            else:
                stego = embed_derived(part, [(keys, os.urandom(800))])
            embedded.append(features(stego))
            scenes.append(scene)
            models.append(model)
        secret = whole
    groups, owners = np.unique(scenes, return_inverse=True)[1], np.array(models)
    count = len(scenes)
    print(f"{len(arguments)} models of {groups.max() + 1} scenes in {count} parts")
    print("every part both plain and embedded:")
    x, y = np.array(plain + embedded), np.repeat([0, 1], count)
    _report([(x, y)], np.tile(groups, 2), np.tile(owners, 2))
    print("every part either plain or embedded, six draws:")
    draws = [np.random.default_rng(seed).permutation(np.arange(count) % 2) for seed in range(6)]
    _report([(np.where(y[:, None] == 1, embedded, plain), y) for y in draws], groups, owners)


def _report(draws: list[tuple[npt.NDArray[np.float64], Labels]], groups: Labels, owners: Labels) -> None:
    """Mean AUC over the draws and, of one draw, its standard error."""
    found = [(held_out_scores(x, y, groups), y) for x, y in draws]
    for name in found[0][0]:
        auc = np.mean([roc_auc_score(y, scores[name]) for scores, y in found])
        error = np.mean([standard_error(scores[name], y, owners) for scores, y in found])
        print(f"  {name}: AUC {auc:.3f}, standard error {error:.3f}")


if __name__ == "__main__":
    main(sys.argv[1:])
