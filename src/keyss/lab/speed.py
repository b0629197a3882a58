"""Rendering and revealing times, and file sizes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
import torch

from keyss.core.gaussians import Gaussians
from keyss.core.picture_network import DecodedGaussians
from keyss.core.scene import Scene
from keyss.files.models import DECODED_SUFFIX, read_model, write_model
from keyss.fitting.image_metrics import subsample_views
from keyss.lab.robustness.survival import Opener, reveal_changed
from keyss.rendering import render


@dataclass(frozen=True)
class RenderTime:
    """The time of one render of a model."""

    seconds: float  # median
    ratio: float  # median over pairs of renders, relative to a plain model of the scene; cancels other load


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
            name = f"secret {number}"
            files[name], took = _reveal_to_file(stego, opener, Path(folder) / name)
            seconds.append(took)
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


def _reveal_to_file(stego: Path, opener: Opener, out: Path, *, repeats: int = 3) -> tuple[Path, float]:
    """The revealed file (`out` with the suffix of its format), and the median time from file to file."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        revealed = reveal_changed(opener, read_model(stego))
        file = out.with_suffix(DECODED_SUFFIX if isinstance(revealed, DecodedGaussians) else ".ply")
        write_model(file, revealed)
        seconds.append(time.perf_counter() - start)
    return file, median(seconds)
