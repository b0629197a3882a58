"""Names of options, importable without torch."""

from __future__ import annotations

from typing import Literal

Publish = Literal["unchanged", "converted"]
ConvertedChannel = Literal["appended", "colours"]  # for `publish="converted"`
Format = Literal["ply", "spz", "sog", "compressed-ply"]  # for `publish="unchanged"`
