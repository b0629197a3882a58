"""Capacity, cost and robustness of the channel `colours`.

python benchmarks/colours.py MODEL.ply ... [--gaussians N] [--payloads P] [--changes]
                                [--only FORMAT] [--size BYTES]
python benchmarks/colours.py MODEL.ply ... --payloads N --log FILE [--gaussians N] [--foreign-each M]
python benchmarks/colours.py SCENE-1.ply SCENE-2.ply ... --pairs FOLDER [--shares 1 0.5 0.2 0.05]
python benchmarks/colours.py MODEL.ply --speed [--gaussians N]

For each model: net bits per Gaussian, the cost of a full model, and how many of P payloads, each
with a new key and new entropy, are lost in each format, alone and with a quarter of the Gaussians removed at
random. With --changes, also other changes, at full capacity and at a fifth of it. Argon2id is replaced by a
cheap function, except with --speed.

With --log, N payloads in total, distributed over the models, go through the formats that keyss writes, and
each M-th also through third-party programs. Each payload appends a line of JSON; payloads in the file are
skipped.

With --pairs, nothing is measured: each model, with and without a payload of a share of its capacity, is
converted to each format and back, and `FOLDER/FORMAT-SHARE.txt` lists the files for `xargs python
benchmarks/stealth.py --quick --pairs < FILE`. With --speed: seconds and memory of writing 200 bytes, and of
reading with a right and a wrong key, Argon2id included. `--gaussians` samples each model to this size (with
--speed, even beyond its own).

pip install gsply npm install --no-save @playcanvas/splat-transform@2.7.1   (or KEYSS_SPLAT_TRANSFORM)
"""

from __future__ import annotations

import argparse
import re
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from keyss import lab
from colours_payloads import run_payloads
from keyss.channels import COLOURS, ColoursCover, ColoursReader, Payload
from keyss.core.errors import BackendError, InputError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.files.models import read_model, write_model
from keyss.rendering.orbit import psnr_between

import numpy as np
import torch
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import cheap_keys

Change = Callable[[Gaussians], Gaussians]
FIFTH = 0.2
METHOD, PACKED = "t", 2  # payload header: method, and bytes beside the data


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--gaussians", type=int)
    parser.add_argument("--payloads", type=int, default=5)
    parser.add_argument("--log", type=Path, metavar="FILE")
    parser.add_argument("--foreign-each", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="seed of keys, payloads and removals")
    parser.add_argument("--size", type=int, help="bytes of a payload (default: the capacity)")
    parser.add_argument("--changes", action="store_true")
    parser.add_argument("--only", default="", help="formats with this in their name")
    parser.add_argument("--pairs", type=Path, metavar="FOLDER")
    parser.add_argument("--shares", type=float, nargs="+", default=[1.0, 0.5, 0.2, 0.05])
    parser.add_argument("--speed", action="store_true")
    asked = parser.parse_args()
    if not asked.speed:
        cheap_keys.pytest_sessionstart()
    if asked.pairs:
        _write_pairs(asked.models, asked.pairs, asked.shares, asked.only)
        return
    if asked.speed:
        _measure_speed(asked.models, asked.gaussians)
        return
    if asked.log:
        run_payloads(
            [(path.stem, partial(_read, path, asked.gaussians)) for path in asked.models],
            asked.payloads,
            asked.log,
            foreign={what: change for what, change in _BY_TOOL.items() if asked.only in what},
            each=asked.foreign_each,
            embed=_embed,
            opens=_opens,
        )
        return
    print("| model | Gaussians | cost, dB | bytes | bits per Gaussian | what | failures |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for path in asked.models:
        model = _read(path, asked.gaussians)
        prepared = COLOURS.prepare(model)
        name = f"{path.stem} | {len(prepared.cover):,}"
        formats = {what: change for what, change in FORMATS.items() if asked.only in what}
        share = 1.0 if asked.size is None else asked.size / prepared.capacity.bytes
        _measure(prepared, name, formats, asked.payloads, asked.seed, share, pruned=True)
        if asked.changes:
            _measure(prepared, name, OTHERS, asked.payloads, asked.seed)
            _measure(prepared, name, OTHERS, asked.payloads, asked.seed, FIFTH)


def _read(path: Path, gaussians: int | None) -> Gaussians:
    """At most `gaussians` of the model."""
    model = read_model(path)
    return _resample(model, gaussians) if gaussians is not None and gaussians < len(model) else model


def _embed(prepared: ColoursCover, number: int, data: bytes) -> Gaussians:
    return prepared.embed([(_key(number), Payload(METHOD, data))], entropy=number.to_bytes(32, "big"))


def _measure(
    prepared: ColoursCover,
    name: str,
    wanted: dict[str, Change],
    payloads: int,
    first: int,
    share: float = 1.0,
    pruned: bool = False,
) -> None:
    """Print a row for each change in `wanted`."""
    size, failures, psnrs = round(share * (prepared.capacity.bytes - PACKED)), Counter[str](), []
    missing: set[str] = set()
    for seed in range(first, first + payloads):
        data = np.random.default_rng(seed).bytes(size)
        stego = _embed(prepared, seed, data)
        psnrs.append(psnr_between(prepared.cover, stego))
        for what, change in wanted.items():
            try:
                changed = change(stego)
            except BackendError:
                missing.add(what)
                continue
            failures[what] += not _opens(changed, seed, data)
            if pruned:
                removed = lab.random_pruning(0.25, seed)(changed)
                failures[f"{what}, 25 % removed"] += not _opens(removed, seed, data)
    bits = 8 * size / len(prepared.cover)
    start = f"| {name} | {np.mean(psnrs):.1f} ({min(psnrs):.1f}) | {size:,} | {bits:.2f}"
    for what in wanted:
        if what in missing:
            print(f"{start} | {what} | not measured |")
            continue
        rows = (what, f"{what}, 25 % removed") if pruned else (what,)
        for row in rows:
            print(f"{start} | {row} | {failures[row]} of {payloads} |", flush=True)


def _write_pairs(models: Sequence[Path], folder: Path, shares: Sequence[float], only: str) -> None:
    wanted = {what: change for what, change in FORMATS.items() if only in what}
    lines: dict[str, list[str]] = {}
    for number, path in enumerate(models):
        scene, prepared = path.stem.rsplit("-", 1)[0], COLOURS.prepare(read_model(path))
        made = {"plain": prepared.cover}
        for share in shares:
            size = int(share * (prepared.capacity.bytes - PACKED))
            data = np.random.default_rng(number).bytes(size)
            stego = made[f"{share:g}"] = _embed(prepared, number, data)
            print(
                f"{path.stem} {share:g}: {size:,} bytes, {psnr_between(prepared.cover, stego):.1f} dB",
                flush=True,
            )
        for what, change in wanted.items():
            own = folder / re.sub("[^a-z]+", "-", what).strip("-")
            own.mkdir(parents=True, exist_ok=True)
            for name, model in made.items():
                write_model(own / f"{path.stem}-{name}.ply", change(model))
                if name != "plain":
                    pair = f"{scene}={own}/{path.stem}-plain.ply:{own}/{path.stem}-{name}.ply"
                    lines.setdefault(f"{own.name}-{name}", []).append(pair)
    for name, pairs in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(pairs) + "\n")


def _measure_speed(models: Sequence[Path], gaussians: int | None) -> None:
    print("| model | Gaussians | embed | extract | wrong key | most memory |")
    print("| --- | --- | --- | --- | --- | --- |")
    for path in models:
        model = _resample(read_model(path), gaussians)
        seconds = []
        stego = model
        for step in ("embed", "right", "wrong"):
            start = time.monotonic()
            if step == "embed":
                stego = COLOURS.prepare(model).embed([("a key of some length", Payload(METHOD, bytes(200)))])
            elif step == "right":
                ColoursReader.of(stego).open("a key of some length")
            else:
                with suppress(WrongKeyError):
                    ColoursReader.of(stego).open("another key of some length")
            seconds.append(f"{time.monotonic() - start:.1f} s")
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"| {path.stem} | {len(model):,} | {' | '.join(seconds)} | {memory:,.0f} MiB |", flush=True)


def _resample(model: Gaussians, count: int | None) -> Gaussians:
    """Sample `count` Gaussians; beyond the model's own number, repeat them at slightly random scales."""
    if count is None:
        return model
    generator = torch.Generator().manual_seed(0)
    rows = torch.randperm(len(model), generator=generator)
    if count > len(model):
        rows = torch.randint(len(model), (count,), generator=generator)
        jitter = 0.2 * torch.randn(count, 3, generator=generator)
        return replace(model[rows], log_scales=model.log_scales[rows] + jitter)
    return model[rows[:count]]


def _opens(model: Gaussians, seed: int, data: bytes) -> bool:
    try:
        return ColoursReader.of(model).open(_key(seed)) == Payload(METHOD, data)
    except (WrongKeyError, InputError):
        return False


def _key(seed: int) -> str:
    return f"key number {seed}"


def _move(scale: float) -> Change:
    rotation = torch.from_numpy(Rotation.from_euler("xyz", [0.3, 1.1, -2.0]).as_matrix())
    return Similarity(scale, rotation, torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)).apply_gaussians


def _shuffle(model: Gaussians) -> Gaussians:
    return model[torch.randperm(len(model), generator=torch.Generator().manual_seed(0))]


def _append_copy(share: float) -> Change:
    """Append a share of the model, moved, scaled and with mirrored colours, as another scene."""

    def apply(model: Gaussians) -> Gaussians:
        other = _move(1.3)(model[: int(share * len(model))])
        return Gaussians.cat([model, Gaussians(*_parts(other))])

    def _parts(other: Gaussians) -> tuple[torch.Tensor, ...]:
        opacity_logits = -0.5 - 0.7 * other.opacity_logits
        return other.means, other.quats, other.log_scales.flip(1), opacity_logits, -other.sh

    return apply


def _chain(first: Change, second: Change) -> Change:
    return lambda model: second(first(model))


_BY_TOOL: dict[str, Change] = {f"{each.format} by {each.tool}": each for each in lab.converters()}
FORMATS: dict[str, Change] = {"raw `.ply`": lambda model: model, **_BY_TOOL}
OTHERS: dict[str, Change] = {
    "reordered": _shuffle,
    "cropped to a half": lab.cropping(1),
    "50 % removed at random": lab.random_pruning(0.5, 1),
    "25 % of lowest opacity removed": lab.opacity_pruning(0.25),
    "another scene a quarter as large": _append_copy(0.25),
    "another scene as large": _append_copy(1.0),
    "without harmonics": lab.fewer_harmonics(0),
    "half floats": lab.half_floats(),
    "rotated and moved": _move(1.0),
    "scaled by 1.37, rotated and moved": _move(1.37),
    "`.spz` by gsply, then scaled": _chain(_BY_TOOL[".spz by gsply"], _move(1.37)),
    "scaled, then `.spz` by gsply": _chain(_move(1.37), _BY_TOOL[".spz by gsply"]),
    "noise on colour, 0.01 of its spread": lab.noise("colour", 0.01),
    "noise on colour, 0.03 of its spread": lab.noise("colour", 0.03),
    "noise on log scales, 0.01 of their spread": lab.noise("log scale", 0.01),
    "noise on opacity, 0.01 of its spread": lab.noise("logit opacity", 0.01),
}


if __name__ == "__main__":
    start = time.monotonic()
    main()
    print(f"\n{time.monotonic() - start:.0f} s")
