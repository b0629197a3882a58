"""Where bits can lie in a published model, and how a reader finds them again: one protocol, four channels."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from keyss.channels.appended.channel import APPENDED as APPENDED
    from keyss.channels.appended.channel import AppendedReader as AppendedReader
    from keyss.channels.appended.lattice import is_appended as is_appended
    from keyss.channels.base import Channel as Channel
    from keyss.channels.base import Content as Content
    from keyss.channels.base import METHOD_BYTES as METHOD_BYTES
    from keyss.channels.base import Payload as Payload
    from keyss.channels.base import PreparedCover as PreparedCover
    from keyss.channels.base import RecordPlan as RecordPlan
    from keyss.channels.base import RecordRequest as RecordRequest
    from keyss.channels.base import Records as Records
    from keyss.channels.base import Room as Room
    from keyss.channels.base import pack_method as pack_method
    from keyss.channels.base import unpack_method as unpack_method
    from keyss.channels.codes.channel import CodesChannel as CodesChannel
    from keyss.channels.codes.channel import CodesCover as CodesCover
    from keyss.channels.codes.channel import CodesReader as CodesReader
    from keyss.channels.colours.channel import Colours as Colours
    from keyss.channels.colours.channel import ColoursCover as ColoursCover
    from keyss.channels.low_bits.bits import identities as identities
    from keyss.channels.low_bits.bits import read_low_bits as read_low_bits
    from keyss.channels.low_bits.channel import LOW_BITS as LOW_BITS
    from keyss.channels.low_bits.channel import LowBitsCover as LowBitsCover
    from keyss.channels.low_bits.reading import LowBitsReader as LowBitsReader
    from keyss.channels.low_bits.spread import TYPICAL_SHARE as TYPICAL_SHARE
    from keyss.channels.low_bits.spread import check_payload_fits as check_payload_fits
    from keyss.channels.low_bits.usable import chance_of_bits as chance_of_bits
    from keyss.channels.low_bits.usable import is_uniform as is_uniform
    from keyss.channels.low_bits.usable import usable_carriers as usable_carriers
    from keyss.channels.opening import open_content as open_content
    from keyss.channels.opening import quick_attempt as quick_attempt
    from keyss.channels.publishing import AnyChannel as AnyChannel
    from keyss.channels.publishing import Publish as Publish
    from keyss.channels.publishing import STRENGTH as STRENGTH
    from keyss.channels.publishing import SUFFIXES as SUFFIXES
    from keyss.channels.publishing import channel_for as channel_for
    from keyss.channels.publishing import suffix_of as suffix_of
else:
    from keyss._lazy import lazily

    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.channels.appended.channel": ("APPENDED", "AppendedReader"),
            "keyss.channels.appended.lattice": ("is_appended",),
            "keyss.channels.base": (
                "Channel",
                "Content",
                "METHOD_BYTES",
                "Payload",
                "PreparedCover",
                "RecordPlan",
                "RecordRequest",
                "Records",
                "Room",
                "pack_method",
                "unpack_method",
            ),
            "keyss.channels.codes.channel": ("CodesChannel", "CodesCover", "CodesReader"),
            "keyss.channels.colours.channel": ("Colours", "ColoursCover"),
            "keyss.channels.low_bits.bits": ("identities", "read_low_bits"),
            "keyss.channels.low_bits.channel": ("LOW_BITS", "LowBitsCover"),
            "keyss.channels.low_bits.reading": ("LowBitsReader",),
            "keyss.channels.low_bits.spread": ("TYPICAL_SHARE", "check_payload_fits"),
            "keyss.channels.low_bits.usable": ("chance_of_bits", "is_uniform", "usable_carriers"),
            "keyss.channels.opening": ("open_content", "quick_attempt"),
            "keyss.channels.publishing": (
                "AnyChannel",
                "Publish",
                "STRENGTH",
                "SUFFIXES",
                "channel_for",
                "suffix_of",
            ),
        },
    )
