"""3DGS+SH: a second set of harmonics on the same Gaussians (a baseline of GS-Hider, 2024, and KeySS).

The published model is a 3DGS model of the cover. The secret's harmonics are handed over: with them in place
of its own, the published model shows the secret.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.parameters import make_optimizers
from keyss.methods.base import Capabilities
from keyss.methods.joint import Picture
from keyss.methods.peers.method import JointPeer, PeerOptions, PeerTraining, gaussians_of
from keyss.methods.peers.payload import HandedSecret, HandedTensors

_NAMES = ("sh", "secret_sh")  # parameters with the colours of the cover and of the secret


class ShTraining(PeerTraining):
    """The training of two sets of harmonics; everything else is shared."""

    def prepare(self, start: Gaussians) -> None:
        """Both start equal: every point has the colour of its own scene."""
        optimizer = make_optimizers(self.parameters, self.options.fit, self.extent)["sh"]
        self.add(_NAMES[1], start.sh.clone(), optimizer)

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        opacities = self.parameters["opacities"]
        models = [gaussians_of(self.parameters, opacities, self.parameters[name]) for name in _NAMES]
        return [self.render(models[scene], scene, camera, sh_degree) for scene in scenes]


@dataclass(frozen=True, kw_only=True)
class ShOptions(PeerOptions):
    """See `PeerOptions`."""

    method: ClassVar[str] = "3dgs-sh"


class ShMethod(JointPeer):
    """See `keyss.methods.base.Method`."""

    name = ShOptions.method
    summary = "second harmonics for the secret, handed over (baseline)"
    capabilities = Capabilities(keys=False, hands_over=True)
    options = ShOptions
    training = ShTraining

    def publish(self, run: ShTraining) -> tuple[Gaussians, HandedTensors]:
        kept = run.kept()
        stego = gaussians_of(kept, kept["opacities"], kept["sh"])
        return stego, HandedTensors({_NAMES[1]: kept[_NAMES[1]]}, run.frame, rows=len(stego))

    def open(self, handed: HandedTensors) -> HandedSecret:
        (sh,) = handed.taken([_NAMES[1]])
        return HandedSecret(handed, lambda stego: replace(stego, sh=sh))


METHOD = ShMethod()
unpack = METHOD.unpack
