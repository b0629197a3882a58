"""The paper's theta: which attributes the decoder updates, spelled `op,ro,sc,xyz` on the command line."""

from __future__ import annotations

from typing import Literal, get_args

from keyss.core.errors import UsageError

Attribute = Literal["op", "ro", "sc", "xyz", "sh"]  # opacity, rotation, scale, position, colour
Mask = tuple[Attribute, ...]
ATTRIBUTES: Mask = get_args(Attribute)


def parse_mask(text: str) -> Mask:
    """The attributes named in `text`, in canonical order. Raises UsageError for unknown or no names."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    unknown = sorted(names - set(ATTRIBUTES))
    if unknown or not names:
        raise UsageError(
            f"mask {text!r}: expected some of {','.join(ATTRIBUTES)}, got {','.join(unknown) or 'none'}"
        )
    return tuple(name for name in ATTRIBUTES if name in names)
