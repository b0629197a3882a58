"""Quality of a hiding after conversion by third-party programs: the table of docs/channels.md.

    python benchmarks/publication.py RUN --key-file key.txt [--only NAME ...]

RUN: a folder of `keyss hide --publish converted` with one secret. Each program converts the published model
and the cover's plain model to each format; the secret is revealed from the converted file. PSNR in dB against
the test photos.

    pip install gsply
    npm install --no-save @playcanvas/splat-transform@2.7.1   (or KEYSS_SPLAT_TRANSFORM)
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from keyss import reveal
from codes import against_photos
from keyss.core import BackendError, Gaussians, KeyssError
from keyss.files import read_model, write_model
from keyss.lab import Converter, converters
from keyss.runs.open_run import HidingRun, open_run


def row(run: HidingRun, name: str, converter: Converter | None) -> str:
    """Quality of cover and secret after one program's conversion; None: as published."""
    cover, secret = run.scenes(train_pictures=False)
    plain = run.plain_models()[0]
    if plain is None:
        raise SystemExit(f"{run.folder} has no plain model of its cover")
    stego, size, untouched = run.stego, 0, 0
    if converter is not None:
        (stego, size), (plain, untouched) = _convert(converter, stego), _convert(converter, plain)
    try:
        revealed = f"{against_photos(reveal(stego, run.keys[0]).gaussians, secret):.2f}"
    except KeyssError as error:
        revealed = f"lost ({type(error).__name__})"
    covers = [against_photos(each, cover) for each in (plain, stego)]
    sizes = f"{untouched / 1e6:.2f} / {size / 1e6:.2f} ({size / untouched:.2f})" if size else ""
    return f"| {name} | {sizes} | {covers[0]:.2f} / {covers[1]:.2f} | {revealed} |"


def _convert(converter: Converter, model: Gaussians) -> tuple[Gaussians, int]:
    """Convert a model and back; also returns the bytes of the converted file."""
    with TemporaryDirectory() as folder:
        source = Path(folder) / "source.ply"
        write_model(source, model)
        there, back = converter.round_trip(source, Path(folder))
        return read_model(back), there.stat().st_size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--key-file", type=Path, required=True)
    parser.add_argument("--only", nargs="*", metavar="NAME", help='such as ".spz by gsply" (default: all)')
    asked = parser.parse_args()
    run = open_run(asked.run, [asked.key_file.read_text().strip()])
    plain = [len(each) for each in run.plain_models() if each is not None]
    own = [len(each.reveal(run.stego)) for each in run.opened]
    print(f"{asked.run.name}: {len(run.stego):,} Gaussians, cover {plain[0]:,}, secret {own[0]:,}\n")
    plain_secret = run.plain_models()[1]
    if plain_secret is not None:
        print(f"plain secret: {against_photos(plain_secret, run.scenes(train_pictures=False)[1]):.2f} dB\n")
    print("| what | MB, plain / published (ratio) | cover, plain / published (dB) | secret (dB) |")
    print("| --- | --- | --- | --- |")
    print(row(run, "`.ply`, as published", None), flush=True)
    for converter in converters():
        name = f"{converter.format} by {converter.tool}"
        if asked.only and name not in asked.only:
            continue
        try:
            print(row(run, name, converter), flush=True)
        except (BackendError, ImportError) as error:
            print(f"| {name} | not measured: {error} | | |", flush=True)


if __name__ == "__main__":
    main()
