"""Reading a payload with nothing but a model and a key."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from keyss.channels.base import Payload, unpack_payload
from keyss.channels.colours.carriers import CELL, Carriers, Numbers, Salts
from keyss.channels.colours.fountain import Fountain
from keyss.channels.colours.header import (
    FILE_KEY_BYTES,
    IDLE,
    SHARES,
    VIEWS,
    Header,
    Index,
    bucket_bytes,
    check_secret,
    data_key,
    derived,
    header_agreement,
    read_header,
)
from keyss.channels.colours.lattice import COLUMNS, LEVELS, dithers, read, seeds
from keyss.channels.reed_solomon import LOST
from keyss.core.errors import InputError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.encryption import decrypt

ASSOCIATED = b"keyss/v1/colours"  # authenticated with a payload
# Shares of the other carriers that may hold something else: in ordinary files, in merged ones.
_CHANGED, _MERGED = 0.03, 0.5
_ROUNDS = 60
_MAX_RATE = 4.0  # data bits for each code bit; a writer stays below a half of one
_CELLS_AROUND = (0, 1, -1, 2, -2, 3, -3, 4, -4)  # where a writer may have had its zero, in cells
_CELLS_SCALED = (0, 1, -1)  # in a model that was scaled
_ALIGNMENTS = 7  # of borders of cells: in a model that was scaled names are wrong by a fifth at most
_BEST = 3  # of all these, that are looked at more closely
# The header that a key that opens nothing looks for.
_NOTHING = Header(bytes(FILE_KEY_BYTES), bytes(2), LEVELS - 1, 1, 0, SHARES // 4 - 1, 64, 0)
_REFINED = ((0.02, 0.004), (0.004, 0.001))  # where offsets are looked for once a header is found


@dataclass(frozen=True)
class ColoursReader:
    """A model as a reader sees it."""

    numbers: Numbers

    @staticmethod
    def of(model: Gaussians) -> ColoursReader:
        return ColoursReader(Numbers.of(model))

    def open(self, key: str) -> Payload:
        """See `keyss.channels.base.Reader`.

        Takes about 0.1 s for each of 17 salts, and as long for a key that opens nothing as for one that does,
        unless the model was scaled.
        """
        static, secrets = derived(key, Salts.of(self.numbers).salts)
        check = check_secret(static)
        promises = [(index.promise(secrets), offset) for offset, index in self._indices()]
        best = [offset for _, offset in sorted(promises, reverse=True)[:_BEST]]
        indices = [Index(self.numbers.carriers(offset)) for offset in best]
        attempts = [  # all, as a key that opens nothing does
            read_header(secrets, check, index, kind, view) for index in indices for kind, view in VIEWS
        ]
        headers = list(dict.fromkeys(header for header in attempts if header is not None))
        agreements = [
            (header_agreement(header, check, secrets, index), header, offset)
            for header in headers or [_NOTHING]
            for offset, index in zip(best, indices, strict=True)
        ]
        if not headers:  # take about as long as for reading a payload
            _payload(_NOTHING, static, self.numbers.carriers(0.0), _CHANGED, _ROUNDS // 4)
            raise WrongKeyError()
        # One attempt in 2^16 finds a false header, and a right one can be read under wrong names.
        _, header, offset = max(agreements, key=itemgetter(0))
        carriers = self._refined(header, check, secrets, offset)
        free = np.ones(len(carriers), bool)
        index = Index(carriers)
        for secret in secrets:
            free[index.rows(secret, header.kind)] = False
        for changed in (_CHANGED, _MERGED):
            payload = _payload(header, static, carriers[free], changed)
            if payload is not None:
                return unpack_payload(payload)
        raise InputError(LOST)

    def _indices(self) -> Iterator[tuple[float, Index]]:
        """The log scales that the writer may have taken for zero, and the carriers by their names then."""
        if not len(self.numbers.rows):
            return
        whole = round(self.numbers.size / CELL) * CELL
        for alignment in range(_ALIGNMENTS):
            offset = whole + alignment * CELL / _ALIGNMENTS
            carriers = self.numbers.carriers(offset)
            for cells in _CELLS_SCALED if alignment else _CELLS_AROUND:
                yield offset + cells * CELL, Index(carriers.shifted(cells))

    def _refined(self, header: Header, check: bytes, secrets: tuple[bytes, ...], offset: float) -> Carriers:
        """The carriers; in a model that was scaled, under the names that agree best with the header."""
        if offset % CELL:
            for reach, step in _REFINED:
                offsets = offset + np.arange(-reach, reach + step / 2, step)
                every = [Index(self.numbers.carriers(float(each))) for each in offsets]
                agree = [header_agreement(header, check, secrets, each) for each in every]
                offset = float(offsets[int(np.argmax(agree))])
        return self.numbers.carriers(offset)


def _payload(
    header: Header, static: bytes, carriers: Carriers, changed: float, rounds: int = _ROUNDS
) -> bytes | None:
    """The payload that the header's data key decrypts, or None."""
    own = carriers[header.own(carriers)]
    size, key, counts = bucket_bytes(header.bucket), data_key(static, header), header.bits(own)
    if not len(own) or 8 * size > _MAX_RATE * COLUMNS * counts.sum():
        return None
    garbage = min(0.9, header.idle * IDLE + changed)
    doubt = 1 - (1 - garbage) * (1 - own.doubt) / own.namesakes()
    ratios = read(dithers(key, own.names), own, counts, doubt)
    bits, _ = Fountain(8 * size).decode(seeds(key, "seeds", own.names, counts), ratios, rounds)
    try:
        return decrypt(key, np.packbits(bits).tobytes(), ASSOCIATED)
    except InputError:
        return None
