"""Errors of each format in each attribute of a model, for docs/formats.md.

    pip install gsply
    npm install --no-save @playcanvas/splat-transform@2.7.1
    python benchmarks/formats.py fits/bonsai.ply fits/fox.ply

Each program writes every model, and keyss reads it. For visible Gaussians (opacity above 0.05): root mean
square and 99th percentile of the change; also bytes per Gaussian, and PSNR between renders before and after.
Missing programs are skipped.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from keyss.core import BackendError, Gaussians, Similarity
from keyss.files import read_model, write_model
from keyss.lab import transform
from keyss.rendering import psnr_between

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

VISIBLE = 0.05
Writer = Callable[[Path, Path], object]  # converts a .ply


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+")
    asked = parser.parse_args()
    names = ("format, writer", "B/G", "position", "log scale", "rotation, degrees", "opacity", "f_dc")
    print("|", " | ".join([*names, "SH 1", "SH 2, 3", "PSNR, dB"]), "|")
    print("|", " | ".join(["---"] * 10), "|")
    for name, suffix, writer in writers():
        try:
            found = [through(path, suffix, writer) for path in asked.models]
        except BackendError as error:
            print(f"({name}: {error})")
            continue
        sizes, psnrs, changes = zip(*found, strict=True)
        cells = [f"{np.mean(sizes):.0f}", *_cells(changes), ", ".join(f"{psnr:.1f}" for psnr in psnrs)]
        print("|", " | ".join([name, *cells]), "|", flush=True)


def writers() -> list[tuple[str, str, Writer]]:
    """Names, suffixes and writers."""

    def ours(source: Path, target: Path) -> None:
        write_model(target, read_model(source))

    def gsply_spz(source: Path, target: Path) -> None:
        import gsply

        # gsply does not rotate models into the frame of an .spz.
        turn = Similarity(rotation=torch.diag(torch.tensor([1.0, -1.0, -1.0])))
        model, turned = turn.apply_gaussians(read_model(source)), target.with_suffix(".turned.ply")
        model = replace(model, quats=read_model(source).quats * torch.tensor([1.0, 1.0, -1.0, -1.0]))
        write_model(turned, model)
        gsply.write_spz(target, gsply.plyread(turned), version=3)

    def gsply_compressed(source: Path, target: Path) -> None:
        import gsply

        gsply.plywrite(target, gsply.plyread(source), compressed=True)

    kept = [
        (f"`.{suffix}`, keyss", suffix, ours) for suffix in ("spz", "sog", "compressed.ply", "glb", "splat")
    ]
    others: list[tuple[str, str, Writer]] = [
        ("`.spz`, splat-transform", "spz", transform),
        ("`.spz`, gsply", "spz", gsply_spz),
        ("`.sog`, splat-transform", "sog", transform),
        ("`.compressed.ply`, splat-transform", "compressed.ply", transform),
        ("`.compressed.ply`, gsply", "compressed.ply", gsply_compressed),
        ("`.glb`, splat-transform", "glb", transform),
    ]
    return sorted([*kept, *others], key=lambda each: each[1])


def through(path: Path, suffix: str, writer: Writer) -> tuple[float, float, list[tuple[float, float]]]:
    """Bytes per Gaussian, PSNR, and change of each attribute of a written model."""
    before = read_model(path)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.ply", Path(folder) / f"out.{suffix}"
        write_model(source, before)
        writer(source, target)
        after, size = read_model(target), target.stat().st_size
    return size / len(before), psnr_between(before, after), changes(before, after)


def changes(before: Gaussians, after: Gaussians) -> list[tuple[float, float]]:
    """Root mean square and 99th percentile of each attribute's change, for the nearest Gaussians."""
    index = torch.from_numpy(_nearest(before, after))
    visible = before.opacities > VISIBLE
    a, b = before[visible], after[index[visible]]
    unit_a, unit_b = (torch.nn.functional.normalize(each.quats.double()) for each in (a, b))
    angles = 2 * torch.rad2deg(torch.acos((unit_a * unit_b).sum(1).abs().clamp_max(1)))
    higher = b.with_sh_degree(before.sh_degree).sh - a.sh if b.sh_degree else None
    differences: list[Tensor | None] = [b.means - a.means, b.log_scales - a.log_scales, angles]
    differences += [b.opacities - a.opacities, b.sh[:, 0] - a.sh[:, 0]]
    differences += [None, None] if higher is None else [higher[:, 1:4], higher[:, 4:]]
    return [_spread(difference) for difference in differences]


def _nearest(before: Gaussians, after: Gaussians) -> np.ndarray:
    """[N] rows of `after` nearest to those of `before` in position, size and colour together."""

    def features(model: Gaussians) -> np.ndarray:
        parts = zip((model.means, model.log_scales, model.sh[:, 0]), scales, (50, 1, 1), strict=True)
        return torch.cat([part / scale * weight for part, scale, weight in parts], dim=1).numpy()

    scales = [values.std(0) for values in (before.means, before.log_scales, before.sh[:, 0])]
    found: np.ndarray = cKDTree(features(after)).query(features(before))[1]
    return found


def _spread(difference: Tensor | None) -> tuple[float, float]:
    if difference is None:
        return float("nan"), float("nan")
    values = difference.double().abs().flatten()
    return float(values.square().mean().sqrt()), float(np.quantile(values.numpy(), 0.99))


def _cells(every: tuple[list[tuple[float, float]], ...]) -> list[str]:
    """Means over models for each attribute, as "rms / 99th percentile"."""
    means = np.mean(np.array(every), axis=0)
    return ["lost" if np.isnan(rms) else f"{_short(rms)} / {_short(most)}" for rms, most in means]


def _short(value: float) -> str:
    return "0" if value < 5e-6 else f"{value:.2g}" if value < 1e-3 else f"{value:.3f}".lstrip("0")


if __name__ == "__main__":
    main()
