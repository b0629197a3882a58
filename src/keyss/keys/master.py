"""Master keys: one key derives the keys of many named assets.

The master key goes through Argon2id with a fixed salt, so the master key and a name suffice to open an asset,
and guessing the master key from a derived key is as slow as guessing any key. HKDF-Expand (RFC 5869) then
derives an independent key for each name. Equal master keys give equal keys everywhere, and a fixed salt
allows guesses in advance: use a key of `keyss keygen` as a master key, not a password.
"""

from __future__ import annotations

import hashlib
import unicodedata

from keyss.core.errors import UsageError
from keyss.keys.derivation import SALT_BYTES, DerivedKey
from keyss.keys.key_file import ALPHABET, KEY_LENGTH

_SALT = hashlib.sha256(b"keyss/v1/master").digest()[:SALT_BYTES]
_MAX_NAME_BYTES = 4096


class MasterKey:
    """A master key. Deriving it takes about 0.1 s; names then cost next to nothing."""

    def __init__(self, key: str) -> None:
        self._derived = DerivedKey.of(key, _SALT)

    def key_of(self, name: str) -> str:
        """The key of a name: 22 letters and digits.

        Names are normalised to NFC. Raises UsageError for a name that is empty, not text, or too long.
        """
        if len(name) > _MAX_NAME_BYTES:  # normalising takes quadratic time
            raise UsageError(f"expected a name of 1 to {_MAX_NAME_BYTES} bytes, got {len(name)} characters")
        try:
            data = unicodedata.normalize("NFC", name).encode()
        except UnicodeEncodeError as error:
            raise UsageError(f"{name!r}: expected a name in UTF-8") from error
        if not 1 <= len(data) <= _MAX_NAME_BYTES:
            raise UsageError(f"expected a name of 1 to {_MAX_NAME_BYTES} bytes, got {len(data)}")
        # Hashed, so that no name can imitate the label of another use.
        label = f"master/{hashlib.sha256(data).hexdigest()}"
        number = int.from_bytes(self._derived.expand(label, 32), "big")
        characters = []
        for _ in range(KEY_LENGTH):  # 131 of 256 bits: uniform to 2^-125
            number, digit = divmod(number, len(ALPHABET))
            characters.append(ALPHABET[digit])
        return "".join(characters)
