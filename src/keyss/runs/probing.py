"""How long pictures and training steps of a scene take here, from a few of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from keyss.core.decoded import PictureNetwork
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene, View
from keyss.fitting.config import FitConfig
from keyss.fitting.losses import Target, photometric_loss
from keyss.fitting.parameters import (
    initial_gaussians,
    initial_points,
    make_optimizers,
    to_gaussians,
    to_parameters,
)
from keyss.rendering import render_with_meta
from keyss.rendering.decoding import decode_picture, draw_features

PROBES = 3  # steps that are timed, after one that is not
MOST_PROBED = 500_000  # Gaussians of a model that is made to be timed; more take longer in proportion
NETWORK_PIXELS = 2**16  # that go through a network to time it: what it takes is even over pixels


class Probe:
    """Times of one scene's pictures and training steps, for any number of Gaussians.

    `network`: pictures go through it, and features as many as it takes are drawn in place of harmonics unless
    they are three.
    """

    def __init__(
        self,
        scene: Scene,
        model: Gaussians | None,
        config: FitConfig,
        sh_degree: int,
        device: torch.device,
        trains: bool,
        network: PictureNetwork | None = None,
    ) -> None:
        self.scene, self.device, self.config, self.trains = scene, device, config, trains
        self.sh_degree, self.model = sh_degree, model
        self.network = None if network is None else network.map(lambda values: values.to(device))
        if model is None:
            self.start = min(config.max_gaussians, len(scene.points) if len(scene.points) >= 100 else 20_000)
            counts = {min(count, MOST_PROBED) for count in (self.start, config.max_gaussians)}
            models = [_made_up(scene, count, config) for count in counts]
        else:
            self.start = len(model)
            models = [model.with_sh_degree(sh_degree) if trains else model]
        # (Gaussians, seconds of a picture, seconds of a step) in ascending order
        self.times = sorted(
            (len(each), self._time_picture(each), self._time_step(each, trains)) for each in models
        )
        if self.network is not None:
            picture, step = self._time_network(self.network)
            self.times = [(count, own + picture, more + step) for count, own, more in self.times]

    def through(self, network: PictureNetwork) -> Probe:
        """Times of the same scene's pictures by way of a network."""
        return Probe(
            self.scene, self.model, self.config, self.sh_degree, self.device, self.trains, network=network
        )

    def picture(self, gaussians: float) -> float:
        """Seconds of one picture."""
        return self._at(gaussians, 1)

    def step(self, gaussians: float) -> float:
        """Seconds of one step of training with one picture."""
        return self._at(gaussians, 2)

    def _at(self, gaussians: float, column: int) -> float:
        first, last = self.times[0], self.times[-1]
        if last[0] == first[0]:
            # Pixels and Gaussians cost about the same.
            return float(last[column] * (0.5 + 0.5 * gaussians / last[0]))
        share = (gaussians - first[0]) / (last[0] - first[0])
        return float(max(0.5 * first[column], first[column] + share * (last[column] - first[column])))

    def _views(self) -> list[View]:
        views = self.scene.test
        return [views[index * len(views) // (PROBES + 1)] for index in range(PROBES + 1)]

    @torch.no_grad()
    def _time_picture(self, model: Gaussians) -> float:
        moved = model.to(self.device)
        draw = self._drawing(len(model))
        return _timed(lambda view: float(draw(moved, view.camera).sum()), self._views())

    def _time_step(self, model: Gaussians, trains: bool) -> float:
        if not trains:
            return 0.0
        parameters = to_parameters(model, self.device)
        optimizers = make_optimizers(parameters, self.config, self.scene.extent)
        draw = self._drawing(len(model))

        def step(view: View) -> None:
            image = draw(to_gaussians(parameters), view.camera)[..., :3]
            target = Target.of(view.image.to(self.device))
            photometric_loss(image, target, self.config.ssim_weight).backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            float(parameters["means"].detach().sum())

        return _timed(step, self._views())

    def _drawing(self, count: int) -> Callable[[Gaussians, Camera], Tensor]:
        """What draws `count` Gaussians: [H, W, C] of colours, or of the network's features."""
        channels = 3 if self.network is None else len(self.network.background)
        if channels == 3:
            return lambda model, camera: render_with_meta(model, camera)[0]
        features = torch.full((count, channels), 0.5, device=self.device, requires_grad=self.trains)
        behind = torch.zeros(channels, device=self.device)
        return lambda model, camera: draw_features(model, features, camera, behind)[0]

    def _time_network(self, network: PictureNetwork) -> tuple[float, float]:
        """Seconds of a picture and of a step's way there and back, for this scene's pixels."""
        camera = self.scene.test[0].camera
        pixels = camera.width * camera.height
        rows = max(1, min(camera.height, NETWORK_PIXELS // camera.width))
        drawn = torch.rand(rows, camera.width, len(network.background), device=self.device)

        @torch.no_grad()
        def picture(view: View) -> float:
            return float(decode_picture(drawn, network).sum())

        def step(view: View) -> None:
            attached = network.map(lambda values: values.detach().requires_grad_())
            seen = drawn.clone().requires_grad_()
            decode_picture(seen, attached).sum().backward()
            assert seen.grad is not None
            float(seen.grad.sum())

        views, scale = self._views(), pixels / (rows * camera.width)
        return scale * _timed(picture, views), scale * _timed(step, views) if self.trains else 0.0


def decoding_seconds(
    decode: Callable[[Gaussians], Gaussians],
    scene: Scene,
    count: int,
    config: FitConfig,
    device: torch.device,
) -> float:
    """Seconds of a step's way through a decoder and back, of `count` Gaussians of as many harmonics."""
    made = min(count, MOST_PROBED)
    parameters = to_parameters(_made_up(scene, made, config), device)

    def step(_: View) -> None:
        decoded = decode(to_gaussians(parameters))
        whole = [decoded.means, decoded.quats, decoded.log_scales, decoded.opacity_logits, decoded.sh]
        torch.stack([values.sum() for values in whole]).sum().backward()
        assert parameters["means"].grad is not None
        float(parameters["means"].grad.sum())

    return count / made * _timed(step, [scene.test[0]] * (PROBES + 1))


def _timed(work: Callable[[View], object], views: Sequence[View]) -> float:
    """Mean seconds of `work` on all views but the first."""
    work(views[0])
    start = time.perf_counter()
    for view in views[1:]:
        work(view)
    return (time.perf_counter() - start) / len(views[1:])


def _made_up(scene: Scene, count: int, config: FitConfig) -> Gaussians:
    """A model of `count` Gaussians where the sparse points of `scene` are."""
    generator = torch.Generator().manual_seed(0)
    points, colors = initial_points(scene, count, generator)
    times = -(-count // len(points))
    spread = 0.002 * scene.extent * torch.randn(len(points) * times, 3, generator=generator)
    copies = points.repeat(times, 1) + (spread if times > 1 else 0)
    return initial_gaussians(copies, colors.repeat(times, 1), config.sh_degree, count, generator)
