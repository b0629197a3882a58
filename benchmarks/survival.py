"""Robustness of each channel against each change: the table of docs/formats.md.

    python benchmarks/survival.py MODEL.ply [--bytes N] [--gaussians N] [--photos FOLDER] [--width PIXELS]

A file of random bytes is hidden in a `.ply` (low bits) and an `.spz` (quantised values), and for `--publish
converted` (colours and appended Gaussians). After each change, its key is tried. With `--photos` of its
scene, the model is also fine-tuned. Argon2id is replaced by a cheap function, which does not affect the
result.

pip install gsply npm install --no-save @playcanvas/splat-transform@2.7.1   (or KEYSS_SPLAT_TRANSFORM)
"""

from __future__ import annotations

import argparse
from pathlib import Path

from keyss import CarryOptions, SecretFile, hide, reveal
from colours import FORMATS, OTHERS, OWN, Change, cheap_keys, sampled
from keyss.core import BackendError, Gaussians, InputError, WrongKeyError
from keyss.files import load_scene, read_model
from keyss.lab import fine_tuning
from keyss.methods import HiddenFile

import numpy as np

KEY = "a key of the benchmark 4711"
CHANNELS = {
    "low bits (`ply`)": CarryOptions(publish="unchanged"),
    "quantised values (`spz`)": CarryOptions(format="spz"),
    "colours (`converted`)": CarryOptions(publish="converted", channel="colours"),
    "appended (`converted`)": CarryOptions(publish="converted"),
}


def survives(model: Gaussians, data: bytes, change: Change) -> str:
    """A word for the result of opening after a change."""
    try:
        changed = change(model)
    except BackendError as error:
        return f"not measured: {error}"
    try:
        return "opens" if reveal(changed, KEY).file == HiddenFile("file", data) else "damaged"
    except (WrongKeyError, InputError):
        return "lost"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--bytes", type=int, default=300)
    parser.add_argument("--gaussians", type=int)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--width", type=int, default=200)
    asked = parser.parse_args()
    cheap_keys.pytest_sessionstart()
    model = sampled(read_model(asked.model), asked.gaussians)
    data = np.random.default_rng(0).bytes(asked.bytes)
    secret = SecretFile(data, KEY, "file")
    made = {name: hide(model, [secret], method=options) for name, options in CHANNELS.items()}
    print(f"{asked.model.stem}, {len(model):,} Gaussians, a file of {asked.bytes} bytes\n")
    print(f"| what becomes of the model | {' | '.join(made)} |")
    print("| --- |" + " --- |" * len(made))
    print("| cost (dB) | " + " | ".join(f"{each.psnr:.0f}" for each in made.values()) + " |")
    more = " | ".join(f"{len(each.stego) - len(model):,}" for each in made.values())
    print(f"| Gaussians added | {more} |", flush=True)
    every = {"passed on as it is": lambda model: model, **OWN, **FORMATS, **OTHERS}
    if asked.photos:
        photos = load_scene(asked.photos, width=asked.width)
        every |= {f"{steps} steps of training on": fine_tuning(photos, steps) for steps in (10, 100)}
    for name, change in every.items():
        found = [survives(each.stego, data, change) for each in made.values()]
        print(f"| {name} | {' | '.join(found)} |", flush=True)


if __name__ == "__main__":
    main()
