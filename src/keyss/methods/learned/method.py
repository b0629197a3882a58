"""The learned method: one model trained to show the cover, and through a keyed decoder the secrets.

*Key-Secured 3D Secrets within 3D Gaussian Splatting* (KeySS), with the corrections in `docs/method.md`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from keyss.channels.base import Content, Payload
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.methods.base import Capabilities, Context, KeyedSource, Opened, SceneInput, Source, Stego
from keyss.methods.learned.options import PRESETS, LearnedOptions


class LearnedMethod:
    """See `keyss.methods.base.Method`."""

    name = "learned"
    summary = "train one model that shows both"
    capabilities = Capabilities(
        trains=True,
        decoder=True,
        standard_file=True,
        most_secrets=9,
        sidecar=True,
        recommended_for="files that will be converted, and nobody attacks (with --sidecar)",
    )
    options = LearnedOptions
    presets: Mapping[str, LearnedOptions] = PRESETS

    def prepare(self, inputs: Sequence[SceneInput], options: LearnedOptions) -> LearnedOptions:
        """Sized for models where they are all there is; refuses models too small for their low bits."""
        from keyss.methods.learned.pipeline import check_room, encoder_of
        from keyss.methods.learned.sizing import sized

        options = sized(options, inputs)
        encoder_of(options)  # says what is missing
        if not options.sidecar:
            check_room(options, [each.model for each in inputs])
        return options

    def hide(
        self, cover: Source, secrets: Sequence[KeyedSource], options: LearnedOptions, context: Context
    ) -> Stego:
        """See `keyss.methods.learned.pipeline`."""
        from keyss.methods.learned.pipeline import hide

        return hide(cover, secrets, options, context)

    def unpack(self, content: Content) -> Opened:
        """A decoder, and where the secret lies. Raises InputError for damage."""
        from keyss.methods.learned.payload import unpack_secret
        from keyss.methods.learned.revealing import OpenedSecret

        if not isinstance(content, Payload):
            raise InputError("what the key opens is damaged: expected one payload, got records")
        return OpenedSecret(unpack_secret(content.data))

    def attacks(self, stego: Gaussians, secrets: int) -> Mapping[str, Gaussians]:
        """The opacity remaps of a warm start are in the source; nothing else is known without a key."""
        from keyss.methods.learned.attacks import known_remaps

        return known_remaps(stego, secrets)
