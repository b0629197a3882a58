"""One key for many things: from a master key and a name, the key of what has that name.

The master key goes through Argon2id with a salt that is the same everywhere, so that nothing but the master
key and the name is needed to open a thing. That makes guessing a master key from a key that was derived from
it as slow as guessing any key. HKDF-Expand (RFC 5869) then gives each name a key of its own, which tells
nothing of the others or of the master key. Equal master keys give equal keys everywhere, and a salt that is
known lets guesses be made in advance: a master key is to be one of `keyss keygen`, not a password.
"""

from __future__ import annotations

import hashlib
import unicodedata

from keyss.core.errors import UsageError
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation
from keyss.keys.generation import ALPHABET

KEY_LENGTH = 22  # characters of 5.95 bits: 131 bits
_SALT = hashlib.sha256(b"keyss/v1/master").digest()[:SALT_BYTES]
_LONGEST = 4096  # bytes of a name


class MasterKey:
    """What a master key becomes; takes about 0.1 s once, and nothing for each name."""

    def __init__(self, key: str) -> None:
        self._derived = DerivedKey(key, KeyDerivation(salt=_SALT))

    def key_of(self, name: str) -> str:
        """The key of what is called `name`: 22 letters and digits.

        Names are compared in Unicode's form NFC. Raises UsageError for one that is empty, not text, or too
        long.
        """
        try:
            data = unicodedata.normalize("NFC", name).encode()
        except UnicodeEncodeError as error:
            raise UsageError(f"{name!r}: expected a name in UTF-8") from error
        if not 1 <= len(data) <= _LONGEST:
            raise UsageError(f"expected a name of 1 to {_LONGEST} bytes, got {len(data)}")
        # Hashed, so that a label cannot be made to look like that of another use.
        label = f"master/{hashlib.sha256(data).hexdigest()}"
        number = int.from_bytes(self._derived.expand(label, 32), "big")
        characters = []
        for _ in range(KEY_LENGTH):  # of 256 bits the last 131: uniform to 2^-125
            number, digit = divmod(number, len(ALPHABET))
            characters.append(ALPHABET[digit])
        return "".join(characters)

    def check(self) -> str:
        """32 hexadecimal digits by which this master key is known again; a guess costs as much as any."""
        return self._derived.expand("master-check", 16).hex()
