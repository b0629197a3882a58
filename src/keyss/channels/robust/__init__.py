"""Colours of Gaussians that are known by their other numbers: survives formats that round, and much else."""

from keyss.channels.robust.channel import STRENGTH, Key, RobustCover, capacity, embed
from keyss.channels.robust.reading import extract
from keyss.channels.robust.repair import check_repairable, repaired

__all__ = ["STRENGTH", "Key", "RobustCover", "capacity", "check_repairable", "embed", "extract", "repaired"]
