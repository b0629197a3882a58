"""The last bits of the codes of a final .spz, .sog or compressed .ply: exact, and lost in any other file."""

from keyss.channels.codes.channel import CodesCover, CodesReader, payload_size

__all__ = ["CodesCover", "CodesReader", "payload_size"]
