"""3DGS+SH: a second set of harmonics on the same Gaussians (a baseline of GS-Hider, 2024, and KeySS).

The published model is a 3DGS model of the cover. The secret's harmonics are a companion file and replace the
cover's to show the secret.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.parameters import to_gaussians
from keyss.lab.baselines.baseline import Baseline, BaselineTraining, CompanionTensors, Show
from keyss.lab.baselines.baseline_options import ShOptions
from keyss.methods.keyss.training import Picture
from keyss.methods.method import Capabilities

_NAMES = ("sh", "secret_sh")  # parameters with the colours of the cover and of the secret


class ShTraining(BaselineTraining):
    """The training of two sets of harmonics; everything else is shared."""

    def prepare(self, start: Gaussians) -> None:
        """Both sets start equal: every point has the colour of its own scene."""
        (rates,) = self.optimizers["sh"].param_groups
        self.add(_NAMES[1], start.sh.clone(), rates["lr"], rates["lr_scale"])

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        model = to_gaussians(self.parameters)
        models = [replace(model, sh=self.parameters[_NAMES[scene]]) for scene in scenes]
        return [self.render(*pair, camera, sh_degree) for pair in zip(models, scenes, strict=True)]

    def result(self) -> tuple[Gaussians, CompanionTensors]:
        visible, secret_sh = self.visible(), self.parameters[_NAMES[1]].detach()
        stego = to_gaussians(self.parameters).detach()[visible].to("cpu")
        return stego, CompanionTensors({_NAMES[1]: secret_sh[visible]}, self.scenes[1].frame, rows=len(stego))


def _open(companion: CompanionTensors) -> Show:
    (sh,) = companion.take([_NAMES[1]])
    return lambda stego: replace(stego, sh=sh)


METHOD = Baseline(options=ShOptions, capabilities=Capabilities(keys=False), open=_open, training=ShTraining)
