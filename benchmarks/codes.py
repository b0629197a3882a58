"""Capacity and cost of carrying in quantised values: the tables of docs/channels.md.

    python benchmarks/codes.py --data FOLDER --pair bonsai=cover.ply,fox=secret.ply
    python benchmarks/codes.py --files FOLDER --format spz bonsai=a.ply bonsai=b.ply fox=c.ply ...
    python benchmarks/stealth.py --quick --pairs $(cat FOLDER/pairs)

The second command writes an untouched and a nine-tenths-full file of each model, and lists them for the
third, which measures how well they can be distinguished.

Each `--pair` names a folder of photos in `--data` and a model of it for the cover, then for the secret
(without the folder, renders of the model replace photos). The secret is as large as fits, at most a sixth of
the cover's Gaussians, of SH degree 0. Costs are relative to the untouched file of the format.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from keyss.channels import SUFFIXES, Payload, QuantisedReader, quantised_channel
from keyss.channels.lsb.fields import FORMATS
from keyss.core import Gaussians, Scene
from keyss.files.formats.common import in_morton_order
from keyss.files.models import read_model, write_model
from keyss.files.scenes import load_scene
from keyss.fitting import mean_psnr
from keyss.methods import encode_to_size, most_visible, prune_to_size
from keyss.methods.codec.model_bytes import decode, encode
from keyss.rendering.orbit import psnr_between, scene_of_model

HEAD = (
    "| cover | Gaussians | format | bits per Gaussian | cover against photos, untouched / carrying (dB) "
    "| untouched against carrying (dB) | secret Gaussians per cover Gaussian "
    "| secret against its photos, in this format / carried (dB) | hide, reveal (s) |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)
KEY = "a key of the benchmark 4711"
SHARE = 6


def scene_for(folder: Path, model: Gaussians, width: int) -> Scene:
    """The photos of a folder, or pictures of the model."""
    return (
        load_scene(folder, width=width) if folder.is_dir() else scene_of_model(model, folder.name, size=width)
    )


def against_photos(model: Gaussians, scene: Scene) -> float:
    """Mean PSNR in dB over the test views."""
    return mean_psnr(model, scene.test, scene.background)


def print_rows(cover: tuple[str, Gaussians], secret: tuple[str, Gaussians], data: Path, width: int) -> None:
    """Print a row of the table for each format."""
    own = most_visible(secret[1].with_sh_degree(0), len(cover[1]) // SHARE)
    scenes = [scene_for(data / name, model, width) for name, model in (cover, secret)]
    for name, format_ in FORMATS.items():
        model = in_morton_order(cover[1])
        untouched = format_.quantise(model).dequantise()
        start = time.monotonic()
        prepared = quantised_channel(name).prepare(cover[1])
        left = prepared.capacity.bytes
        kept = prune_to_size(own, left)
        encoded = encode_to_size(kept, left)
        stego = prepared.embed([(KEY, Payload("carry", encoded))])
        file = stego.codes.serialise()
        hiding = time.monotonic() - start
        start = time.monotonic()
        opened = decode(QuantisedReader.of(format_.parse(file)).open(KEY).data)
        revealing = time.monotonic() - start
        bits = 8 * left / len(model)
        most = 8 * left / (8 * len(encode(kept)) / len(kept)) / len(model)
        in_format = format_.quantise(in_morton_order(kept)).dequantise()
        numbers = [
            *(against_photos(each, scenes[0]) for each in (untouched, stego)),
            *(against_photos(each, scenes[1]) for each in (in_format, opened)),
        ]
        print(
            f"| {cover[0]} | {len(model):,} | {stego.codes.name} | {bits:.1f} "
            f"| {numbers[0]:.2f} / {numbers[1]:.2f} | {psnr_between(untouched, stego):.1f} "
            f"| 1 : {1 / most:.1f} | {numbers[2]:.2f} / {numbers[3]:.2f} | {hiding:.1f}, {revealing:.1f} |",
            flush=True,
        )


def files(folder: Path, format_name: str, models: list[str]) -> None:
    """Write pairs of files, and the file `pairs` with the arguments of benchmarks/stealth.py."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for model in models:
        scene, _, path = model.partition("=")
        cover = quantised_channel(format_name).prepare(read_model(path))
        plain, stego = (
            folder / f"{Path(path).stem}-{kind}{SUFFIXES[format_name]}" for kind in ("plain", "stego")
        )
        payload = Payload("carry", os.urandom(cover.capacity.bytes * 9 // 10))
        write_model(plain, read_model(path))
        write_model(stego, cover.embed([(KEY, payload)]))
        found.append(f"{scene}={plain}:{stego}")
    (folder / "pairs").write_text("\n".join(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("models", nargs="*", metavar="SCENE=FILE", help="for --files")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--pair", action="append", default=[], metavar="NAME=FILE,NAME=FILE")
    parser.add_argument("--files", type=Path, metavar="FOLDER")
    parser.add_argument("--format", choices=tuple(FORMATS), default="spz")
    parser.add_argument("--width", type=int, default=200, help="width of renders in pixels")
    arguments = parser.parse_args()
    if arguments.files:
        files(arguments.files, arguments.format, arguments.models)
    if not arguments.pair:
        return
    print(HEAD)
    for pair in arguments.pair:
        cover, secret = (part.partition("=")[::2] for part in pair.split(","))
        models = [(name, read_model(path)) for name, path in (cover, secret)]
        print_rows(models[0], models[1], arguments.data, arguments.width)


if __name__ == "__main__":
    main()
