"""Foreign Gaussians: what appended secrets and notes in colours tell of other models, formats and attacks.

    python benchmarks/foreign.py SCENE-1.ply SCENE-2.ply OTHER-1.ply ... [--gaussians N]

A note is appended to each model. Prints which share of the model its Bloom filter takes for foreign: of the
model after each change, of the other models (of its scene or of another, by the name before the dash), and of
what an attacker makes of two files, so that the note of one opens in what looks like the other. Argon2id is
replaced by a cheap function.

For colours, prints how well everybody can tell carrying models from plain ones by the Gaussians of the salts:
the area under the ROC curve (AUC) of the mean percentile of their colour residuals, given red and 12
neighbours, with a note of 20 bytes, and the same of the next 32 Gaussians by the same public hash.
"""

from __future__ import annotations

import argparse
import warnings
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from colours import FORMATS, OTHERS, OWN, cheap_keys, sampled
from keyss.channels import APPENDED, COLOURS, AppendedReader, Carriers, Payload
from keyss.channels.colours import carriers as salting
from keyss.channels.colours.carriers import find_salts
from keyss.core import BackendError, Gaussians, InputError, KeyssWarning, Similarity, WrongKeyError
from keyss.core.arrays import Doubles
from keyss.files import read_model
from keyss.lab import auc_between
from keyss.rendering import psnr_between

import numpy as np
import torch
from scipy.spatial import cKDTree

KEY, NOTE = "a key of the benchmark 4711", Payload("t", b"a note of twenty b..")
Attack = Callable[[Gaussians, Gaussians], Gaussians]


def specks(cover: Gaussians, appended: Gaussians) -> Gaussians:
    """30,000 small and faint copies of one Gaussian, scattered."""
    one = cover[torch.full((30_000,), int(cover.opacities.argmax()))]
    jitter = torch.randn(one.means.shape, generator=torch.Generator().manual_seed(0)) * cover.means.std()
    faint = torch.full_like(one.opacity_logits, -4.0)
    small = replace(one, means=one.means + jitter, log_scales=one.log_scales - 6, opacity_logits=faint)
    return Gaussians.cat([small, appended])


def scaled(model: Gaussians, by: float) -> Gaussians:
    return Similarity(by).apply_gaussians(model)


# From the model whose note is to open, and what is appended to it: what is put into another file.
ATTACKS: dict[str, Attack] = {
    "what is appended": lambda cover, appended: appended,
    "30,000 specks of one Gaussian": specks,
    "two shrunken covers": lambda cover, appended: Gaussians.cat([*[scaled(cover, 1e-3)] * 2, appended]),
    "cover and appended, shrunken": lambda cover, appended: scaled(Gaussians.cat([cover, appended]), 1e-3),
    "cover and appended": lambda cover, appended: Gaussians.cat([cover, appended]),
    "cover and appended, enlarged": lambda cover, appended: scaled(Gaussians.cat([cover, appended]), 30),
    "nine tenths of the file left out": lambda cover, appended: Gaussians.cat([cover[::10], appended]),
}


def share(model: Gaussians) -> float:
    """The share of a model's Gaussians that its secret takes for foreign; NaN if it does not open."""
    reader = AppendedReader.of(model)
    if reader is None:
        return float("nan")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KeyssWarning)
        try:
            foreign = reader.open(KEY).foreign
        except (InputError, WrongKeyError):
            return float("nan")
    return min(1.0, foreign / max(1, int((model.opacities > 3.5 / 255).sum())))


def residuals(model: Gaussians) -> tuple[Carriers, Doubles]:
    """The carriers, and percentiles [C] of the colour that red and 12 neighbours do not explain."""
    carriers = Carriers.of(model)
    colours, means = carriers.colours, model.means.double().numpy()[carriers.rows]
    near = colours[cKDTree(means).query(means, k=13)[1][:, 1:]].mean(axis=1)
    known = np.column_stack([np.ones(len(colours)), colours[:, 0], near])
    left = colours[:, 1:] - known @ np.linalg.lstsq(known, colours[:, 1:], rcond=None)[0]
    sizes = np.abs(left).sum(axis=1)
    return carriers, sizes.argsort().argsort() / len(sizes)


def percentiles(model: Gaussians) -> tuple[float, float]:
    """Means of `residuals` of the Gaussians of the salts, and of the next 32."""
    carriers, found = residuals(model)
    rows = find_salts(carriers)[0]
    number, salting.SALTS = salting.SALTS, 3 * salting.SALTS
    more = find_salts(carriers)[0]
    salting.SALTS = number
    return float(found[rows].mean()), float(found[np.setdiff1d(more, rows)].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--gaussians", type=int)
    parser.add_argument("--colours", action="store_true", help="only the Gaussians of the salts")
    asked = parser.parse_args()
    cheap_keys.pytest_sessionstart()
    covers = {path.stem: sampled(read_model(path), asked.gaussians) for path in asked.models}
    if asked.colours:
        compare_salts(covers)
        return
    shares: dict[str, list[float]] = defaultdict(list)
    for index, (name, cover) in enumerate(covers.items()):
        stego = APPENDED.prepare(cover).embed([(KEY, NOTE)], entropy=index.to_bytes(32, "big"))
        appended = stego[len(cover) :]
        for what, change in {**OWN, **FORMATS, **OTHERS}.items():
            try:
                shares[what].append(share(change(stego)))
            except BackendError:
                continue
        for other, host in covers.items():
            if other != name:
                same = other.rsplit("-", 1)[0] == name.rsplit("-", 1)[0]
                both = Gaussians.cat([host.with_sh_degree(0), appended.with_sh_degree(0)])
                shares[f"another model of {'the same' if same else 'another'} scene"].append(share(both))
        host = list(covers.values())[(index + 1) % len(covers)].with_sh_degree(0)
        for what, attack in ATTACKS.items():
            made = Gaussians.cat([host, attack(cover, appended).with_sh_degree(0)])
            shares[f"attack: {what}"].append(share(made))
            if what.startswith("30"):
                print(f"{name}: specks leave {psnr_between(host, made):.1f} dB", flush=True)
    print("| | opened | foreign: least | mean | most |\n| --- | --- | --- | --- | --- |")
    for what, every in shares.items():
        own = [each for each in every if each == each]
        if own:
            opened = f"{len(own)} of {len(every)}"
            print(f"| {what} | {opened} | {min(own):.3f} | {np.mean(own):.3f} | {max(own):.3f} |")


def compare_salts(covers: dict[str, Gaussians]) -> None:
    """Print the AUC by the Gaussians of the salts."""
    plain = np.array([percentiles(cover) for cover in covers.values()])
    carrying = []
    for index, cover in enumerate(covers.values()):
        stego = COLOURS.prepare(cover).embed([(KEY, NOTE)], entropy=index.to_bytes(32, "big"))
        carrying.append(percentiles(stego))
    for column, what in enumerate(("16 Gaussians of the salts", "the next 32")):
        before, after = plain[:, column], np.array(carrying)[:, column]
        print(
            f"{what}: plain {before.mean():.2f} ({before.std():.2f}), carrying {after.mean():.2f} "
            f"({after.std():.2f}), AUC {auc_between(before.tolist(), after.tolist()).auc:.2f}"
        )


if __name__ == "__main__":
    main()
