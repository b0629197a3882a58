"""Opening with a key, in whichever channel of a model the secret lies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

from keyss.channels import robust
from keyss.channels.appended import AppendedReader
from keyss.channels.base import Content
from keyss.channels.codes import CodesReader
from keyss.channels.low_bits import LowBitsReader
from keyss.channels.packing import unpack_payload
from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians
from keyss.keys.derivation import DerivedKey, KeyDerivation


def open_content(stego: Gaussians, key: str) -> Content:
    """What `key` opens in the codes of a file's model or in the low bits of another, or in what survives
    other formats: appended Gaussians, then colours. Raises WrongKeyError and InputError.
    """
    with suppress(WrongKeyError):
        if isinstance(stego, CodedGaussians):
            return CodesReader.of(stego.codes).open(key)
        return LowBitsReader.of(stego).open(key)
    if appended := AppendedReader.of(stego):
        with suppress(WrongKeyError):
            return appended.open(key)
    return unpack_payload(robust.extract(stego, key))


def quick_attempts(
    stego: Gaussians, key: str
) -> Iterator[tuple[DerivedKey, CodesReader | LowBitsReader | AppendedReader]]:
    """What a key becomes under the likeliest salt, and what reads with it; none where there is no salt."""
    if appended := AppendedReader.of(stego):  # everybody sees that they are there
        yield DerivedKey(key, KeyDerivation(salt=appended.salt)), appended
    elif isinstance(stego, CodedGaussians):
        codes = CodesReader.of(stego.codes)
        yield DerivedKey(key, KeyDerivation(salt=codes.salt)), codes
    else:
        bits = LowBitsReader.of(stego)
        yield from ((derived, bits) for derived in bits.keys(key, 1))
