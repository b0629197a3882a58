"""What a format that quantises costs the cover and the secret: there, back, and revealed with the sidecar.

    npm install --no-save @playcanvas/splat-transform@2.7.1
    python benchmarks/conversions.py runs/hidden --key-file key.txt

The run is one of `keyss hide --sidecar` with one secret, whose photos are still where they were. Formats
that need splat-transform are left out where it is absent.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import keyss
from keyss.cli.keys import key_of_file
from keyss.core import Gaussians, Scene
from keyss.files.ply import read_ply, write_ply
from keyss.fitting.image_metrics import mean_psnr

REPOSITORY = Path(__file__).resolve().parents[1]
TOOL = shutil.which("splat-transform") or str(REPOSITORY / "node_modules" / ".bin" / "splat-transform")
SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--key-file", type=Path, required=True)
    asked = parser.parse_args()
    key, settings = key_of_file(asked.key_file), json.loads((asked.run / "config.json").read_text())
    cover, secret = (
        keyss.load_scene(path, width=settings["width"])
        for path in (settings["cover"], settings["secrets"][0])
    )
    print("| format | Gaussians | bytes of each | cover, loss | secret, loss |")
    print("| --- | --- | --- | --- | --- |")
    first: tuple[float, float] | None = None
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "stego.ply"
        shutil.copy(asked.run / "stego.ply", source)
        for name, convert in FORMATS.items():
            if convert in (_by_tool, _splat) and not Path(TOOL).exists():
                print(f"| {name} | splat-transform is not installed | | | |")
                continue
            there, back = convert(source, Path(folder) / f"a{name.split()[0]}")
            stego = read_ply(back)
            revealed = keyss.reveal(stego, key, decoder=asked.run / "decoder.sealed", force=True)
            found = _psnr(stego, cover), _psnr(revealed, secret)
            first = first or found
            cells = [f"{now:.2f}, {before - now:.2f}" for now, before in zip(found, first, strict=True)]
            size = there.stat().st_size / len(stego)
            print(f"| {name} | {len(stego):,} | {size:.0f} | {cells[0]} | {cells[1]} |", flush=True)


def _psnr(model: Gaussians, scene: Scene) -> float:
    with torch.no_grad():
        return mean_psnr(model, scene.test, scene.background)


def _same(source: Path, target: Path) -> tuple[Path, Path]:
    return source, source


def _half(source: Path, target: Path) -> tuple[Path, Path]:
    """Half floats have no usual file: 59 values of two bytes are what one would take."""
    back = target.with_suffix(".back.ply")
    halved = read_ply(source).map(lambda values: values.half())
    np.savez(target.with_suffix(".npz"), *(value.numpy() for value in vars(halved).values()))
    write_ply(back, halved.map(lambda values: values.float()))
    return target.with_suffix(".npz"), back


def _by_tool(source: Path, target: Path) -> tuple[Path, Path]:
    back = target.with_suffix(".back.ply")
    for a, b in ((source, target), (target, back)):
        subprocess.run([TOOL, "-q", "-w", "-g", "cpu", str(a), str(b)], check=True, capture_output=True)
    return target, back


def _splat(source: Path, target: Path) -> tuple[Path, Path]:
    """antimatter15's format, which splat-transform only reads: float positions and scales, the rest bytes."""
    model = read_ply(source)
    rows = np.zeros(len(model), dtype=[("p", "<f4", 3), ("s", "<f4", 3), ("c", "u1", 4), ("q", "u1", 4)])
    rows["p"], rows["s"] = model.means.numpy(), model.log_scales.exp().numpy()
    rows["c"][:, :3] = _byte((0.5 + SH_C0 * model.sh[:, 0]) * 255)
    rows["c"][:, 3] = _byte(model.opacity_logits.sigmoid() * 255)
    rows["q"] = _byte(torch.nn.functional.normalize(model.quats, dim=1) * 128 + 128)
    target.write_bytes(rows.tobytes())
    return target, _by_tool(target, target.with_suffix(".copy.ply"))[1]


def _byte(values: torch.Tensor) -> np.ndarray:
    return values.round().clamp(0, 255).to(torch.uint8).numpy()


FORMATS: dict[str, Callable[[Path, Path], tuple[Path, Path]]] = {
    ".ply": _same,
    ".half": _half,
    ".compressed.ply": _by_tool,
    ".spz": _by_tool,
    ".sog": _by_tool,
    ".splat": _splat,
}

if __name__ == "__main__":
    main()
