"""Names of options, without what loads torch."""

from __future__ import annotations

from typing import Literal

Publish = Literal["as-is", "any"]
AnyChannel = Literal["appended", "colours"]  # of a model that may be converted to any format
Format = Literal["ply", "spz", "sog", "compressed-ply"]  # of a model that stays as it is
