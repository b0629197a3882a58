"""What the robust channel carries, what that costs, and what of it survives.

python benchmarks/robust.py MODEL.ply ... [--gaussians N] [--payloads P] [--strengths 45 55] [--changes]
                                [--only FORMAT]

For each model and strength: net bits per Gaussian and the cost of a full model, and how many of P payloads,
each with a new key and new entropy, do not come back from each format, alone and with a quarter of the
Gaussians removed at random on top. With --changes also other changes, at full capacity and at a fifth of it.
`--gaussians` draws so many of each model. Keys skip Argon2id, which has nothing to do with what is measured.

pip install gsply npm install --no-save @playcanvas/splat-transform@2.7.1   (or KEYSS_SPLAT_TRANSFORM)
"""

from __future__ import annotations

import argparse
import hashlib
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from keyss.channels.robust import RobustCover, extract
from keyss.core.errors import BackendError, InputError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.files.models import read_model
from keyss.keys import DerivedKey
from keyss.measure.robustness import changes
from keyss.measure.robustness.conversions import converters
from keyss.rendering.difference import cost

Change = Callable[[Gaussians], Gaussians]
FIFTH = 0.2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--gaussians", type=int)
    parser.add_argument("--payloads", type=int, default=5)
    parser.add_argument("--strengths", type=float, nargs="+", default=[45.0])
    parser.add_argument("--seed", type=int, default=0, help="of keys, payloads and what is removed")
    parser.add_argument("--changes", action="store_true")
    parser.add_argument("--only", default="", help="formats with this in their name")
    asked = parser.parse_args()
    print("| model | Gaussians | asked, dB | cost, dB | bytes | bits per Gaussian | what | failures |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for path in asked.models:
        model = read_model(path)
        if asked.gaussians is not None:
            order = torch.randperm(len(model), generator=torch.Generator().manual_seed(0))
            model = model[order[: asked.gaussians]]
        prepared = RobustCover.of(model)
        for strength in asked.strengths:
            name = f"{path.stem} | {len(model):,} | {strength:.0f}"
            formats = {what: change for what, change in FORMATS.items() if asked.only in what}
            _measure(prepared, strength, name, formats, asked.payloads, asked.seed, pruned=True)
            if asked.changes:
                _measure(prepared, strength, name, OTHERS, asked.payloads, asked.seed)
                _measure(prepared, strength, name, OTHERS, asked.payloads, asked.seed, FIFTH)


def _measure(
    prepared: RobustCover,
    strength: float,
    name: str,
    wanted: dict[str, Change],
    payloads: int,
    first: int,
    share: float = 1.0,
    pruned: bool = False,
) -> None:
    """Prints a row for each change in `wanted`."""
    size, failures, costs = int(share * prepared.capacity(strength)), Counter[str](), []
    missing: set[str] = set()
    for seed in range(first, first + payloads):
        data = np.random.default_rng(seed).bytes(size)
        stego = prepared.embed([(_key(seed), data)], strength=strength, entropy=seed.to_bytes(32, "big"))
        costs.append(cost(prepared.model, stego))
        for what, change in wanted.items():
            try:
                changed = change(stego)
            except BackendError:
                missing.add(what)
                continue
            failures[what] += not _opens(changed, seed, data)
            if pruned:
                removed = changes.random_pruning(0.25, seed)(changed)
                failures[f"{what}, 25 % removed"] += not _opens(removed, seed, data)
    bits = 8 * size / len(prepared.model)
    start = f"| {name} | {np.mean(costs):.1f} ({min(costs):.1f}) | {size:,} | {bits:.2f}"
    for what in wanted:
        if what in missing:
            print(f"{start} | {what} | not measured |")
            continue
        rows = (what, f"{what}, 25 % removed") if pruned else (what,)
        for row in rows:
            print(f"{start} | {row} | {failures[row]} of {payloads} |", flush=True)


def _opens(model: Gaussians, seed: int, data: bytes) -> bool:
    try:
        return extract(model, _key(seed)) == data
    except (WrongKeyError, InputError):
        return False


def _key(seed: int) -> Callable[[bytes], DerivedKey]:
    return lambda salt: DerivedKey.of_master(hashlib.sha256(f"{seed}".encode() + salt).digest())


def _moved(scale: float) -> Change:
    rotation = torch.from_numpy(Rotation.from_euler("xyz", [0.3, 1.1, -2.0]).as_matrix())
    return Similarity(scale, rotation, torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)).apply_gaussians


def _shuffled(model: Gaussians) -> Gaussians:
    return model[torch.randperm(len(model), generator=torch.Generator().manual_seed(0))]


def _beside(share: float) -> Change:
    """Put together with some of itself, moved, mirrored in colour and scaled: another scene of that kind."""

    def apply(model: Gaussians) -> Gaussians:
        other = _moved(1.3)(model[: int(share * len(model))])
        return Gaussians.cat([model, Gaussians(*_parts(other))])

    def _parts(other: Gaussians) -> tuple[torch.Tensor, ...]:
        opacity_logits = -0.5 - 0.7 * other.opacity_logits
        return other.means, other.quats, other.log_scales.flip(1), opacity_logits, -other.sh

    return apply


def _then(first: Change, second: Change) -> Change:
    return lambda model: second(first(model))


_BY_TOOL = {
    f"{each.format} by {each.tool}": (lambda model, each=each: each(model).gaussians) for each in converters()
}
FORMATS: dict[str, Change] = {"raw `.ply`": lambda model: model, **_BY_TOOL}
OTHERS: dict[str, Change] = {
    "reordered": _shuffled,
    "cropped to a half": changes.cropping(1),
    "50 % removed at random": changes.random_pruning(0.5, 1),
    "25 % of lowest opacity removed": changes.opacity_pruning(0.25),
    "another scene a quarter as large": _beside(0.25),
    "another scene as large": _beside(1.0),
    "without harmonics": changes.fewer_harmonics(0),
    "half floats": changes.half_floats(),
    "rotated and moved": _moved(1.0),
    "scaled by 1.37, rotated and moved": _moved(1.37),
    "`.spz` by gsply, then scaled": _then(_BY_TOOL[".spz by gsply"], _moved(1.37)),
    "scaled, then `.spz` by gsply": _then(_moved(1.37), _BY_TOOL[".spz by gsply"]),
    "noise on colour, 0.01 of its spread": changes.noise("colour", 0.01),
    "noise on colour, 0.03 of its spread": changes.noise("colour", 0.03),
    "noise on log scales, 0.01 of their spread": changes.noise("log scale", 0.01),
    "noise on opacity, 0.01 of its spread": changes.noise("logit opacity", 0.01),
}


if __name__ == "__main__":
    start = time.monotonic()
    main()
    print(f"\n{time.monotonic() - start:.0f} s")
