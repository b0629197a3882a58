"""The bound: two plain 3DGS models (Kerbl et al. 2023), one published, one sent. Nothing is hidden."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

from keyss.channels.base import Content
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.methods.base import (
    Capabilities,
    Context,
    KeyedSource,
    Outlook,
    SceneInput,
    Source,
    Stego,
    Training,
)
from keyss.methods.peers.options import PeerOptions, presets_of
from keyss.methods.peers.payload import HandedSecret, HandedTensors

NAME = "3dgs"
_NAMES = tuple(each.name for each in fields(Gaussians))


@dataclass(frozen=True, kw_only=True)
class BoundOptions(PeerOptions):
    """Of plain models; there is no other training."""

    def training(self, scenes: int) -> tuple[Training, ...]:
        """None."""
        return (Training(),) * scenes


class BoundMethod:
    """See `keyss.methods.base.Method`."""

    name = NAME
    summary = "two plain models, the second handed over: nothing is hidden, a bound"
    trains = False
    most_secrets = 1
    capabilities = Capabilities(keys=False, hands_over=True)
    options = BoundOptions
    presets: Mapping[str, PeerOptions] = presets_of(BoundOptions)

    def prepare(self, inputs: Sequence[SceneInput], options: PeerOptions) -> PeerOptions:
        """Nothing can go wrong."""
        return options

    def outlook(self, inputs: Sequence[SceneInput], options: PeerOptions) -> Outlook:
        """Both as they are."""
        fit = options.fit
        cover, secret = (fit.max_gaussians if each.model is None else len(each.model) for each in inputs)
        degree = fit.sh_degree if inputs[0].model is None else inputs[0].model.sh_degree
        return Outlook(cover, degree, secret, secret)

    def hide(
        self, cover: Source, secrets: Sequence[KeyedSource], options: PeerOptions, context: Context
    ) -> Stego:
        """Nothing is done."""
        (secret,) = secrets
        tensors = {name: getattr(secret.source.model, name) for name in _NAMES}
        payload = HandedTensors(tensors).payload(NAME)
        return Stego(cover.model, (self.unpack(payload),), 0.0, handed=(payload,))

    def unpack(self, content: Content) -> HandedSecret:
        """The plain model. Raises InputError for damage."""
        handed = HandedTensors.of(content)
        try:
            model = Gaussians(*handed.taken(_NAMES))
        except ValueError as error:
            raise InputError(f"what was handed over is damaged: {error}") from error
        return HandedSecret(handed, lambda stego: model, aligned=False)
