"""Capacity, cost and robustness of the channel `colours`.

python benchmarks/colours.py MODEL.ply ... [--payloads N] [--gaussians N] [--size BYTES] [--changes]
                                [--only FORMAT] [--foreign-each M] [--log FILE]
python benchmarks/colours.py SCENE-1.ply SCENE-2.ply ... --pairs FOLDER [--shares 1 0.5 0.2 0.05]

N payloads, distributed over the models, go through the formats that keyss writes, each M-th also through
third-party programs: each with a new key and new entropy, alone and with a quarter of the Gaussians removed
at random. With --changes, also through other changes. Prints the cost by model, and failures by format. --log
appends a line of JSON per payload, and skips payloads in the file. Argon2id is replaced by a cheap function.

With --pairs, nothing is measured: each model, with and without a payload of a share of its capacity, is
converted to each format and back, and `FOLDER/FORMAT-SHARE.txt` lists the files for `xargs python
benchmarks/stealth.py --quick --pairs < FILE`. `--gaussians` samples each larger model to this size.

pip install gsply npm install --no-save @playcanvas/splat-transform@2.7.1   (or KEYSS_SPLAT_TRANSFORM)
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from keyss import lab
from keyss.channels import COLOURS, ColoursCover, ColoursReader, Payload
from keyss.core import BackendError, Gaussians, InputError, Similarity, WrongKeyError
from keyss.files import FORMATS, read_model, write_model
from keyss.rendering import psnr_between

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import beta

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import cheap_keys

Change = Callable[[Gaussians], Gaussians]
REMOVED = 0.25  # fraction of the Gaussians
METHOD, PACKED = "t", 2  # payload header: method, and bytes beside the data


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--gaussians", type=int)
    parser.add_argument("--payloads", type=int, default=5)
    parser.add_argument("--log", type=Path, metavar="FILE")
    parser.add_argument("--foreign-each", type=int, default=1)
    parser.add_argument("--size", type=int, help="bytes of a payload (default: the capacity)")
    parser.add_argument("--changes", action="store_true")
    parser.add_argument("--only", default="", help="formats with this in their name")
    parser.add_argument("--pairs", type=Path, metavar="FOLDER")
    parser.add_argument("--shares", type=float, nargs="+", default=[1.0, 0.5, 0.2, 0.05])
    asked = parser.parse_args()
    cheap_keys.pytest_sessionstart()
    if asked.pairs:
        _write_pairs(asked.models, asked.pairs, asked.shares, asked.only)
        return
    log = asked.log
    records = [json.loads(line) for line in log.read_text().splitlines()] if log and log.exists() else []
    prepared: dict[Path, ColoursCover] = {}
    for number in range(len(records), asked.payloads):
        path = asked.models[number % len(asked.models)]
        if path not in prepared:
            prepared[path] = COLOURS.prepare(sampled(read_model(path), asked.gaussians))
        ways = OWN | (CONVERSIONS if number % asked.foreign_each == 0 else {})
        ways = {what: change for what, change in ways.items() if asked.only in what}
        found = _try_payload(prepared[path], number, asked.size, ways, OTHERS if asked.changes else {})
        records.append({"number": number, "model": path.stem, **found})
        if log:
            with log.open("a") as file:
                file.write(json.dumps(records[-1]) + "\n")
    print(_table(records))


def sampled(model: Gaussians, gaussians: int | None) -> Gaussians:
    """At most `gaussians` of the model, in random order; None: the model."""
    if gaussians is None or gaussians >= len(model):
        return model
    return _shuffle(model)[:gaussians]


def _embed(prepared: ColoursCover, number: int, data: bytes) -> Gaussians:
    return prepared.embed([(_key(number), Payload(METHOD, data))], entropy=number.to_bytes(32, "big"))


def _try_payload(
    cover: ColoursCover,
    number: int,
    size: int | None,
    formats: Mapping[str, Change],
    others: Mapping[str, Change],
) -> dict[str, Any]:
    """Hide a payload, and open it after each change."""
    data = np.random.default_rng(number).bytes(size or cover.planner.bytes - PACKED)
    stego = _embed(cover, number, data)
    opened: dict[str, bool] = {}
    for what, change in {**formats, **others}.items():
        try:
            changed = change(stego)
        except BackendError:
            continue
        opened[what] = _opens(changed, number, data)
        if what in formats:
            removed = lab.random_pruning(REMOVED, number)(changed)
            opened[f"{what}, {REMOVED:.0%} removed"] = _opens(removed, number, data)
    cost = round(psnr_between(cover.cover, stego), 2)
    return {"gaussians": len(cover.cover), "bytes": len(data), "cost": cost, "opened": opened}


def _table(records: Sequence[Mapping[str, Any]]) -> str:
    """Tables of payloads by model, and failures by format.

    Without failures in n openings, the failure rate is below 3 / n with 95 % confidence (rule of three).
    """
    lines = [
        "| model | Gaussians | payloads | bytes | bits per Gaussian | cost, dB: mean (least) |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name in dict.fromkeys(record["model"] for record in records):
        own = [record for record in records if record["model"] == name]
        size, gaussians = own[0]["bytes"], own[0]["gaussians"]
        costs = [each["cost"] for each in own]
        lines.append(
            f"| {name} | {gaussians:,} | {len(own)} | {size:,} | {8 * size / gaussians:.2f} "
            f"| {np.mean(costs):.1f} ({min(costs):.1f}) |"
        )
    tries, failures = Counter[str](), Counter[str]()
    for record in records:
        for what, good in record["opened"].items():
            tries[what] += 1
            failures[what] += not good
    lines += ["", "| format | openings | failures | rate below, with 95 % |", "| --- | --- | --- | --- |"]
    for what, count in [*tries.items(), ("all", tries.total())]:
        failed = failures.total() if what == "all" else failures[what]
        lines.append(f"| {what} | {count} | {failed} | {_bound(failed, count):.2%} |")
    return "\n".join(lines)


def _bound(failures: int, count: int) -> float:
    """One-sided 95 % upper bound for a rate (Clopper and Pearson); about 3 / `count` without failures."""
    return float(beta.ppf(0.95, failures + 1, count - failures)) if failures < count else 1.0


def _write_pairs(models: Sequence[Path], folder: Path, shares: Sequence[float], only: str) -> None:
    wanted = {what: change for what, change in CONVERSIONS.items() if only in what}
    lines: dict[str, list[str]] = {}
    for number, path in enumerate(models):
        scene, prepared = path.stem.rsplit("-", 1)[0], COLOURS.prepare(read_model(path))
        made = {"plain": prepared.cover}
        for share in shares:
            size = int(share * (prepared.planner.bytes - PACKED))
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
        logits, scales = -0.5 - 0.7 * other.opacity_logits, other.log_scales.flip(1)
        mirrored = replace(other, log_scales=scales, opacity_logits=logits, sh=-other.sh)
        return Gaussians.cat([model, mirrored])

    return apply


def _convert_by_keyss(suffix: str) -> Change:
    def change(model: Gaussians) -> Gaussians:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"model{suffix}"
            write_model(path, model)
            return read_model(path)

    return change


def _chain(first: Change, second: Change) -> Change:
    return lambda model: second(first(model))


OWN: dict[str, Change] = {
    f"`{suffix}` by keyss": _convert_by_keyss(suffix) for each in FORMATS for suffix in each.suffixes
}
_BY_TOOL: dict[str, Change] = {
    f"{converter.format} by {converter.tool}": converter for converter in lab.converters()
}
CONVERSIONS: dict[str, Change] = {"raw `.ply`": lambda model: model, **_BY_TOOL}
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
