"""The channel that follows from where a model will be published: one table, which everything else asks."""

from __future__ import annotations

from typing import Literal, get_args

from keyss.channels.base import Channel
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians

Publish = Literal["ply", "spz", "sog", "compressed-ply", "any"]
AnyChannel = Literal["appended", "colours"]  # of a model that may be converted to any format

STRENGTH = 45.0  # dB PSNR that views of a model keep, at least, when colours carry something
SUFFIXES = {"spz": ".spz", "sog": ".sog", "compressed-ply": ".compressed.ply"}  # of files whose codes carry


def channel_for(publish: Publish, channel: AnyChannel = "appended", *, strength: float = STRENGTH) -> Channel:
    """The channel for a model that is passed on in the format `publish`, or as "any".

    `strength` (dB): of colours. Loads that channel only. Raises UsageError for what does not go together.
    """
    if publish not in get_args(Publish) or channel not in get_args(AnyChannel):
        raise UsageError(
            f"expected a format to publish in ({', '.join(get_args(Publish))}), and "
            f"{' or '.join(get_args(AnyChannel))} for any, got {publish!r} and {channel!r}"
        )
    if publish == "ply":
        from keyss.channels.low_bits.channel import LOW_BITS

        return LOW_BITS
    if publish != "any":
        from keyss.channels.codes.channel import CodesChannel

        return CodesChannel(publish)
    if channel == "appended":
        from keyss.channels.appended.channel import APPENDED

        return APPENDED
    from keyss.channels.colours.channel import Colours

    return Colours(strength)


def suffix_of(stego: Gaussians) -> str:
    """How the name of a file ends that keeps all that a published model carries."""
    if not isinstance(stego, CodedGaussians):
        return ".ply"
    return SUFFIXES[type(stego.codes).__module__.rpartition(".")[2].replace("_", "-")]
