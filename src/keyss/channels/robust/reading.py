"""Reading a payload with nothing but a model and a key."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from keyss.channels.robust.carriers import CELL, Carriers, Numbers
from keyss.channels.robust.channel import Key, derive
from keyss.channels.robust.fountain import Fountain
from keyss.channels.robust.header import (
    CLASSES,
    DATA_KEY_BYTES,
    Header,
    bucket_bytes,
    class_of,
    header_share,
    places,
    read_header,
)
from keyss.channels.robust.lattice import LEVELS
from keyss.channels.robust.payload import decrypt_payload
from keyss.channels.robust.salts import SALTS, Salts
from keyss.core.errors import InputError, WrongKeyError
from keyss.core.gaussians import Gaussians

_OPENS_NOTHING = "this key opens nothing here"
_DAMAGED = (
    "the key is right, but too much of the model was lost or changed since something was hidden in it: what "
    "is left is not enough to read it"
)
# Shares of carriers that may hold something else, beside other headers: in ordinary files, in merged ones.
_CHANGED, _MERGED = 0.03, 0.5
_ROUNDS = 60
_MOST_RATE = 4.0  # data bits for each code bit; a writer stays below a half of one
_CELLS_AROUND = (0, 1, -1, 2, -2, 3, -3, 4, -4)  # where a writer may have had its zero, in cells
_SALTS_SCALED = 5  # tried in a model that was scaled
_FINEST = 0.02  # steps in which it is looked for in a model that was scaled
_REFINED = ((0.12, 0.01), (0.01, 0.001))  # where it is looked for once the key is known to open something


def extract(model: Gaussians, key: Key) -> bytes:
    """The payload that `key` opens. Raises WrongKeyError where it opens nothing, InputError if it is damaged.

    Takes about 0.1 s for each of ten salts, and for a key that opens nothing as long as for one that opens a
    model that was scaled.
    """
    return Reader(Numbers.of(model)).read(key)


class Reader:
    """A model as a reader sees it."""

    def __init__(self, numbers: Numbers) -> None:
        self._numbers = numbers
        self._salts = Salts.of(numbers)

    def read(self, key: Key) -> bytes:
        """See `extract`."""
        secrets = [derive(key, salt).expand("robust/header", 32) for salt in self._salts.salts[:SALTS]]
        damaged: Counter[bytes] = Counter()
        for header, offset in self._headers(secrets):
            damaged[header.data_key] += 1
            if damaged[header.data_key] > 1:
                continue
            carriers = _without_headers(self._refined(header, offset), secrets)
            for garbage in (header_share(carriers) + _CHANGED, _MERGED):
                payload = _payload(header, carriers, garbage)
                if payload is not None:
                    return payload
        # One header may be there by chance (2^-16 each), two with one data key are not.
        if max(damaged.values(), default=0) > 1:
            raise InputError(_DAMAGED)
        raise WrongKeyError(_OPENS_NOTHING)

    def _headers(self, secrets: list[bytes]) -> Iterator[tuple[Header, float]]:
        """What the key opens, each with what it took for a log scale of zero."""
        found = False
        for offset in self._offsets():
            carriers = self._numbers.carriers(offset)
            scaled = offset % CELL != 0
            for secret in secrets[:_SALTS_SCALED] if scaled else secrets:
                header = read_header(secret, carriers, thorough=not scaled)
                if header is not None:
                    found = True
                    yield header, offset
        if not found:  # the same work as where there is something
            header = Header(bytes(DATA_KEY_BYTES), LEVELS // 2, 0, (1 << CLASSES) - 1, 0)
            _payload(header, self._numbers.carriers(0.0), _CHANGED)

    def _offsets(self) -> Iterator[float]:
        """What the writer may have taken for a log scale of zero, the likeliest first."""
        size = self._numbers.size
        whole = round(size / CELL) * CELL
        yield from (whole + cells * CELL for cells in _CELLS_AROUND)
        steps = int(CELL / _FINEST)
        yield from (size + step * _FINEST for step in sorted(range(-steps, steps + 1), key=abs))

    def _refined(self, header: Header, offset: float) -> Carriers:
        """The carriers; where the model was scaled, under the names with which they fit the lattice best."""
        carriers = self._numbers.carriers(offset)
        if offset % CELL == 0:
            return carriers
        for reach, step in _REFINED:
            offsets = offset + np.arange(-reach, reach + step, step)
            every = [self._numbers.carriers(float(each)) for each in offsets]
            fits = [header.lattice.fit(header.data_key, each) for each in every]
            offset, carriers = float(offsets[np.argmax(fits)]), every[int(np.argmax(fits))]
        return carriers


def _without_headers(carriers: Carriers, secrets: list[bytes]) -> Carriers:
    """Those that hold no header of this key."""
    free = np.ones(len(carriers), bool)
    for secret in secrets:
        free[places(secret, carriers)[0]] = False
    return carriers[free]


def _payload(header: Header, carriers: Carriers, garbage: float) -> bytes | None:
    """What the header's data key decrypts, or None."""
    own = carriers[header.classes >> class_of(carriers) & 1 == 1]
    size = bucket_bytes(header.bucket)
    if not len(own) or 8 * size > _MOST_RATE * header.lattice.bits(own).sum():
        return None
    doubt = 1 - (1 - garbage) * (1 - own.doubt) / own.namesakes()
    ratios = header.lattice.read(header.data_key, own, doubt)
    seeds = header.lattice.seeds(header.data_key, own)
    bits, _ = Fountain.of(8 * size).decode(seeds, ratios, _ROUNDS)
    return decrypt_payload(header.data_key, np.packbits(bits).tobytes())
