"""The time of a render, relative to that of a plain model."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from keyss.core import Gaussians, Scene
from keyss.fitting.image_metrics import subsample_views
from keyss.rendering import render

_VIEWS = 4


@dataclass(frozen=True)
class RenderTime:
    """The time of one render of a model."""

    seconds: float  # median
    ratio: float  # median over pairs of renders, relative to a plain model of the scene; cancels other load


@torch.no_grad()
def measure_render_time(model: Gaussians, plain: Gaussians, scene: Scene, *, rounds: int = 15) -> RenderTime:
    """The render time of `model`, beside `plain`, from a scene's test cameras.

    Each round renders at most four views with both, in alternating order; the first round is a warm-up.
    """
    cameras = [view.camera for view in subsample_views(scene.test, _VIEWS)]
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
