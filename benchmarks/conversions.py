"""What a format that quantises costs the cover and the secret: there, back, and revealed with the sidecar.

    pip install gsply
    npm install --no-save @playcanvas/splat-transform@2.7.1
    python benchmarks/conversions.py runs/hidden --key-file key.txt

The run is one of `keyss hide --sidecar` with one secret, whose photos are still where they were. Formats
whose tool is absent are left out. `keyss.measure.robustness` has these and other changes.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path

import keyss
from keyss.cli.keys import key_of_file
from keyss.core import BackendError, Gaussians
from keyss.files.models import read_model
from keyss.fitting.image_metrics import mean_psnr
from keyss.measure.robustness.changes import half_floats
from keyss.measure.robustness.conversions import converters
from keyss.measure.robustness.survival import Reopener
from keyss.methods.registry import open_model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--key-file", type=Path, required=True)
    parser.add_argument("--sog-iterations", type=int, default=1)
    asked = parser.parse_args()
    settings = json.loads((asked.run / "private" / "config.json").read_text())
    cover, secret = (
        keyss.load_scene(path, width=settings["width"])
        for path in (settings["cover"], settings["secrets"][0])
    )
    stego, source = read_model(asked.run / "publish" / "stego.ply"), asked.run / "publish" / "stego.ply"
    sidecar = (asked.run / "publish" / "decoder.sealed").read_bytes()
    reopen = Reopener(key_of_file(asked.key_file), partial(open_model, sidecar=sidecar))

    def measured(model: Gaussians) -> tuple[float, float]:
        shown = mean_psnr(model, cover.test, cover.background)
        return shown, mean_psnr(reopen(model).gaussians, secret.test, secret.background)

    first = measured(stego)

    def row(name: str, size: float, model: Gaussians) -> None:
        cells = [f"{now:.2f}, {was - now:.2f}" for now, was in zip(measured(model), first, strict=True)]
        print(f"| {name} | {size:.0f} | {cells[0]} | {cells[1]} |", flush=True)

    print("| format | bytes per Gaussian | cover, loss | secret, loss |")
    print("| --- | --- | --- | --- |")
    row("`.ply`", source.stat().st_size / len(stego), stego)
    row("half floats", 2 * (11 + stego.sh[0].numel()), half_floats()(stego))
    for converter in converters(asked.sog_iterations):
        name = f"{converter.format} by {converter.tool}"
        try:
            converted = converter(stego)
        except BackendError as error:
            print(f"| {name} | {error} | | |", flush=True)
            continue
        row(name, converted.bytes / len(converted.gaussians), converted.gaussians)


if __name__ == "__main__":
    main()
