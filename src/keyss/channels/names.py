"""Names of options, importable without torch."""

from __future__ import annotations

from typing import Literal

Publish = Literal["as-is", "any"]
AnyChannel = Literal["appended", "colours"]  # for `publish="any"`
Format = Literal["ply", "spz", "sog", "compressed-ply"]  # for `publish="as-is"`
