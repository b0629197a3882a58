"""Learning rates over the steps of a run.

The rates of 3DGS suit 30,000 steps, and are too small for fewer. Shorter runs start with larger rates, which
decay to those of 3DGS (benchmarks/recipe.py compares them).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from keyss.core.scene import Camera, camera_positions
from keyss.fitting.config import FitConfig
from keyss.fitting.parameters import Optimizers

LAST_RATE = 0.1  # final factor on the rates of a run that settles
_FULL_STEPS = 30_000
_MAX_BOOST = 5.0
_BOOST_GROWTH = 0.54  # exponent; 1,500 steps and fewer get the maximum
_BOOSTED = 0.6  # share of a run with constant, larger rates
_EXPONENTS = {"means": 7 / 4, "opacities": 1 / 4}  # exponents of the boost; 1 for other attributes
_LARGE = 0.05  # size / distance to the nearest camera; larger Gaussians get a smaller boost
_CAMERAS = 32  # cameras used to measure distances
_LARGE_PHOTO, _COARSEST = 200_000, 20_000  # pixels of photos that are shrunk; minimum pixels of shrunk photos
_FOCAL = 1.15  # focal length / sqrt(image area) at which rates equal 3DGS's; 47 degrees


class Schedule:
    """Sets the learning rates of the optimisers of `make_optimizers` before each step of a run.

    Positions: the rate of 3DGS, which decays to 1 % over the run, times `boost` ** (7/4). With a boost, the
    rate is proportional to the distance from the nearest camera over its focal length, not to the scene's
    extent: a step moves near and far Gaussians equally on the screen. Otherwise objects close to the cameras
    and cameras with a narrow field of view would lose up to 10 dB.

    Other attributes: constant at the rate of 3DGS times `boost` (opacities: `boost` ** (1/4)) for 60 % of the
    run, then decaying to the rate of 3DGS, and over the last share `settle` of the run to a tenth. The boost
    of scales and opacities is less the larger a Gaussian is in the nearest view: otherwise Gaussians near the
    cameras grow until each fills a training view, and test views lose up to 7 dB.
    """

    def __init__(self, config: FitConfig, cameras: Sequence[Camera], extent: float) -> None:
        self.config, self.extent = config, extent
        self.boost = boost_of(config)
        chosen = cameras[:: -(-len(cameras) // _CAMERAS)]
        self.positions = camera_positions(chosen)  # [C, 3]
        focals = [
            float(camera.K[0, 0] * camera.K[1, 1]) / (camera.width * camera.height) for camera in chosen
        ]
        self.zooms = torch.tensor(focals).sqrt() / _FOCAL  # [C]

    def set(self, optimizers: Optimizers, iteration: int) -> None:
        """Set the rates of step `iteration`, counted from 1."""
        config = self.config
        progress = iteration / config.iterations
        boosted = min(1.0, (1 - progress) / (1 - _BOOSTED))
        settled = LAST_RATE ** max(0.0, 1 - (1 - progress) / config.settle) if config.settle else 1.0
        for name, optimizer in optimizers.items():
            group = optimizer.param_groups[0]
            initial = group.setdefault("initial_lr", group["lr"])
            factor = self.boost ** _EXPONENTS.get(name, 1.0)
            if name == "means":
                group["lr"] = initial * factor * 0.01**progress
            else:
                group["lr"] = initial * factor**boosted * settled
        # Densification adds rows without a scale after every `refine_every` steps.
        if self.boost > 1 and (iteration - 1) % config.refine_every == 0:
            means, log_scales = (
                optimizers[name].param_groups[0]["params"][0].detach() for name in ("means", "scales")
            )
            pixels = self.pixel_sizes(means)
            optimizers["means"].scale_rows(pixels / self.extent)
            small = _LARGE * pixels / log_scales.amax(1).exp()
            for name in ("scales", "opacities"):
                least = self.boost ** -_EXPONENTS.get(name, 1.0)
                optimizers[name].scale_rows(small.clamp(least, 1.0))

    def pixel_sizes(self, means: Tensor) -> Tensor:
        """[N] relative pixel size at each of `means` [N, 3] for the nearest camera, in world units.

        For cameras of 47 degrees, it equals the distance.
        """
        return (torch.cdist(means, self.positions.to(means)) / self.zooms.to(means)).amin(1)


def shrinking(config: FitConfig, iteration: int, pixels: int) -> int:
    """The factor by which the sides of photos of `pixels` are divided at a step: powers of two, down to 1.

    Shrunk photos have at least 20,000 pixels. Each factor is used for equally many steps.
    """
    if pixels <= _LARGE_PHOTO or iteration > config.coarse * config.iterations:
        return 1
    levels = int(math.log2(pixels / _COARSEST) / 2)
    passed = int(levels * (iteration - 1) / (config.coarse * config.iterations))
    return int(2 ** (levels - passed))


def boost_of(config: FitConfig) -> float:
    """The factor on rates at the start of a run: 5 for 1,500 steps and fewer, 1 for 30,000 and more."""
    if config.boost is not None:
        return config.boost
    return float(min(_MAX_BOOST, max(1.0, (_FULL_STEPS / config.iterations) ** _BOOST_GROWTH)))
