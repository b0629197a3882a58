"""Rendering and revealing times, file sizes, and compatibility with third-party programs."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
import torch

from keyss.core.errors import BackendError, KeyssError
from keyss.core.gaussians import Gaussians
from keyss.core.picture_network import DecodedGaussians
from keyss.core.scene import Scene
from keyss.files.formats.common import CodedGaussians
from keyss.files.models import DECODED_SUFFIX, read_model, write_model
from keyss.fitting.image_metrics import subsample_views
from keyss.lab.robustness.survival import Opener, find_package, reveal_changed, transform
from keyss.rendering import render


@dataclass(frozen=True)
class RenderTime:
    """The time of one render of a model."""

    seconds: float  # median
    ratio: float  # median over pairs of renders, relative to a plain model of the scene; cancels other load


@dataclass(frozen=True)
class ReaderResult:
    """The result of reading a file with a third-party program."""

    reader: str
    loads: bool | None  # True if all values are bitwise equal; None: not tried
    gaussians: int | None = None  # number of Gaussians read
    note: str | None = None  # why it fails or was not tried


@dataclass(frozen=True)
class SpeedResult:
    """Times and sizes of the published model ("stego") and of the revealed ones ("secret N")."""

    render: dict[str, RenderTime]
    reveal_seconds: tuple[float, ...]  # per secret, file to file, with key derivation
    bytes: dict[str, int]


def measure_speed(
    stego: Path,
    openers: Sequence[Opener],  # one for each secret
    scenes: Sequence[Scene],  # the cover, then the secrets
    plains: Sequence[Gaussians],  # plain 3DGS models of the same scenes
    *,
    rounds: int = 15,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> SpeedResult:
    """Measure the published model and the revealed secrets beside plain models of the same scenes.

    `progress`: called with the number of finished models and the total. Raises KeyssError if a secret does
    not open.
    """
    times: dict[str, RenderTime] = {}
    with tempfile.TemporaryDirectory() as folder:
        files, seconds = {"stego": stego}, []
        for number, opener in enumerate(openers, start=1):
            file, median_seconds = reveal_seconds(stego, opener, Path(folder) / str(number))
            files[f"secret {number}"] = file
            seconds.append(median_seconds)
        for number, (name, scene, plain) in enumerate(zip(files, scenes, plains, strict=True)):
            if progress is not None:
                progress(number, len(files))
            model = read_model(files[name]).to(device)
            times[name] = render_time(model, plain.to(device), scene, rounds=rounds)
        sizes = {name: file.stat().st_size for name, file in files.items()}
    return SpeedResult(times, tuple(seconds), sizes)


@torch.no_grad()
def render_time(
    model: Gaussians, plain: Gaussians, scene: Scene, *, views: int = 4, rounds: int = 15
) -> RenderTime:
    """The render time of `model`, beside `plain`, from a scene's test cameras.

    Each round renders at most `views` views with both models, in alternating order; the first round is a
    warm-up.
    """
    cameras = [view.camera for view in subsample_views(scene.test, views)]
    background = scene.background.to(model.device)
    times = np.zeros((rounds + 1, len(cameras), 2))
    for number in range(rounds + 1):
        for index, camera in enumerate(cameras):
            for which in (0, 1) if (number + index) % 2 else (1, 0):
                start = time.perf_counter()
                render((model, plain)[which], camera, background)
                if model.device.type == "cuda":
                    torch.cuda.synchronize()
                times[number, index, which] = time.perf_counter() - start
    seconds, plain_seconds = times[1:].reshape(-1, 2).T
    return RenderTime(float(np.median(seconds)), float(np.median(seconds / plain_seconds)))


def reveal_seconds(stego: Path, opener: Opener, out: Path, *, repeats: int = 3) -> tuple[Path, float]:
    """The revealed file (`out` with the suffix of its format), and the median time from file to file."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        revealed = reveal_changed(opener, read_model(stego))
        file = out.with_suffix(DECODED_SUFFIX if isinstance(revealed, DecodedGaussians) else ".ply")
        write_model(file, revealed)
        seconds.append(time.perf_counter() - start)
    return file, median(seconds)


def readers(path: Path) -> list[ReaderResult]:
    """Read a model file with plyfile, gsply and splat-transform, and compare the copies that they write."""
    programs = {"plyfile": _plyfile, "gsply": _gsply, "splat-transform": transform}
    if path.name.endswith(DECODED_SUFFIX):
        note = "a network renders it: it is not a 3DGS model"
        return [ReaderResult(name, False, note=note) for name in programs]
    expected = read_model(path)
    if path.suffix != ".ply" or isinstance(expected, CodedGaussians):
        note = "only a .ply of floats stores every number exactly"
        return [ReaderResult(name, None, note=note) for name in programs]
    results: list[ReaderResult] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, copied in programs.items():
            try:
                model = read_model(copied(path, Path(folder) / f"{name}.ply"))
            except BackendError as error:
                results.append(ReaderResult(name, None, note=f"{error}"))
            except (KeyssError, OSError, ValueError, KeyError) as error:
                results.append(ReaderResult(name, False, note=f"{error}"))
            else:
                equal = model.digest() == expected.digest()
                results.append(ReaderResult(name, equal, len(model)))
    return results


def _plyfile(source: Path, target: Path) -> Path:
    find_package("plyfile").PlyData.read(source).write(target)
    return target


def _gsply(source: Path, target: Path) -> Path:
    gsply = find_package("gsply")
    gsply.plywrite(target, gsply.plyread(source))
    return target
