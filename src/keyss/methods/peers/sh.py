"""3DGS+SH: a second set of harmonics on the same Gaussians (a baseline of GS-Hider, 2024, and KeySS).

What is published is a 3DGS model of the cover. The secret's harmonics are handed over: with them in place of
its own, the published model shows the secret.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.core.similarity import Similarity
from keyss.fitting.parameters import make_optimizers
from keyss.methods.base import Capabilities
from keyss.methods.peers.joint import JointPeer
from keyss.methods.peers.options import PeerOptions, presets_of
from keyss.methods.peers.payload import HandedSecret, HandedTensors
from keyss.methods.peers.training import PeerRun, Picture
from keyss.methods.poses import PlacedScene
from keyss.rendering import render_with_meta

NAME = "3dgs-sh"
_OF = ("sh", "secret_sh")  # parameters that colour the cover and the secret


class ShRun(PeerRun):
    """Two sets of harmonics; everything else is shared."""

    def prepare(self, start: Gaussians) -> None:
        """The secret's begin as the cover's do: all points have the colours of their own scene."""
        fit = self.options.fit
        optimizer = make_optimizers(self.parameters, fit, self.extent)["sh"]
        self.add(_OF[1], start.sh.clone(), optimizer)

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        opacity_logits = self.parameters["opacities"]
        return [
            render_with_meta(
                Gaussians(**self.geometry(), opacity_logits=opacity_logits, sh=self.parameters[_OF[scene]]),
                camera,
                self.backgrounds[scene],
                sh_degree=sh_degree,
            )
            for scene in scenes
        ]


@dataclass(frozen=True, kw_only=True)
class ShOptions(PeerOptions):
    """See `PeerOptions`."""


class ShMethod(JointPeer):
    """See `keyss.methods.base.Method`."""

    name = NAME
    summary = "second harmonics for the secret, handed over (baseline)"
    capabilities = Capabilities(keys=False, hands_over=True)
    options = ShOptions
    presets: Mapping[str, PeerOptions] = presets_of(ShOptions)

    def begin(self, scenes: Sequence[PlacedScene], options: PeerOptions, device: torch.device) -> ShRun:
        return ShRun(scenes, options, device)

    def publish(self, run: ShRun, frame: Similarity) -> tuple[Gaussians, HandedTensors]:
        kept = run.kept()
        stego = Gaussians(kept["means"], kept["quats"], kept["scales"], kept["opacities"], kept["sh"])
        return stego, HandedTensors({_OF[1]: kept[_OF[1]]}, frame, rows=len(stego))

    def open(self, handed: HandedTensors) -> HandedSecret:
        (sh,) = handed.taken([_OF[1]])

        def show(stego: Gaussians) -> Gaussians:
            try:
                return replace(stego, sh=sh)
            except ValueError as error:
                raise InputError(f"what was handed over does not fit: {error}") from error

        return HandedSecret(handed, show)
