"""Reader of payloads in colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from keyss.channels.base import Payload, unpack_payload
from keyss.channels.colours.carriers import Carriers
from keyss.channels.colours.fountain import Fountain
from keyss.channels.colours.header import IDLE, Header, Secrets, bucket_bytes, places
from keyss.channels.colours.qim import COLUMNS, ONE, bit_counts, read, seeds
from keyss.channels.colours.salt_gaussians import Salts
from keyss.channels.reed_solomon import LOST
from keyss.core.errors import InputError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.encryption import decrypt

ASSOCIATED = b"keyss/v1/colours"  # associated data of a payload's authentication
_CHANGED = 0.03  # share of carriers overwritten since
_MAX_RATE = 4.0  # data bits per code bit; a writer stays below 0.5
_ALIGNMENTS = 4  # offsets of log scales; the best one is wrong by at most 1/8 step in a scaled model
_NOTHING = Header(bytes(5), ONE, 0, 63, 64, 0, 0)  # read for wrong keys, so that all keys take equally long


@dataclass(frozen=True)
class ColoursReader:
    """Reads the colours of a model."""

    alignments: tuple[Carriers, ...]

    @staticmethod
    def of(model: Gaussians) -> ColoursReader:
        return ColoursReader(tuple(Carriers.of(model, each / _ALIGNMENTS) for each in range(_ALIGNMENTS)))

    def open(self, key: str) -> Payload:
        """See `keyss.channels.base.Reader`.

        Takes about 0.1 s for each of 17 salts, for right and wrong keys alike.
        """
        secrets = Secrets.of(key, Salts.of(self.alignments[0]).salts)
        headers = [Header.read(secrets, carriers) for carriers in self.alignments]
        for carriers, header in zip(self.alignments, headers, strict=True):
            if header is None:
                continue
            for shift in (0.0,) if header.level == ONE else (0.0, header.shift(carriers)):
                payload = _payload(header, secrets, carriers, shift)
                if payload is not None:
                    return unpack_payload(payload)
        if any(headers):
            raise InputError(LOST)
        _payload(_NOTHING, secrets, self.alignments[0], 0.0)
        raise WrongKeyError()


def _payload(header: Header, secrets: Secrets, carriers: Carriers, shift: float) -> bytes | None:
    """The payload decrypted by the header's data key, or None."""
    mask = header.carrier_mask(carriers)
    for secret in secrets.salted:
        mask[places(secret, carriers)[0]] = False
    rows = np.flatnonzero(mask)
    size, key, ids = bucket_bytes(header.bucket), secrets.data_key(header), carriers.ids[rows]
    bits = bit_counts(carriers.impact[rows] - shift, header.level)
    if not len(rows) or 8 * size > _MAX_RATE * COLUMNS * bits.sum():
        return None
    written = (1 - header.idle * IDLE) * (1 - _CHANGED)
    sure = written * (1 - carriers.error_probability[rows]) / carriers.id_counts[rows]
    hints = np.repeat(sure, COLUMNS * bits) * read(key, ids, carriers.colours[rows, 1:], bits)
    found = Fountain(8 * size).decode(seeds(key, "seeds", ids, bits), hints)
    try:
        return decrypt(key, np.packbits(found).tobytes(), ASSOCIATED)
    except InputError:
        return None
