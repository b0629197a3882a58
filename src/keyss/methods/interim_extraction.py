"""What a key opens in low bits, as `keyss.channels.base.Channel.extract` gives it, of today's two formats."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress

import numpy as np

from keyss.channels.base import Content, Payload, Records
from keyss.channels.low_bits import container
from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey
from keyss.methods.carry import carrying


def key_for(stego: Gaussians, key: str) -> DerivedKey:
    """What `key` becomes with the first salt."""
    return DerivedKey(key, container.derivation_of(carrying.Carriers.of(stego).salts()[0]))


def extract(stego: Gaussians, key: str, *, salts: int = carrying.SALTS_TRIED) -> Content:
    """What `key` opens. Raises WrongKeyError, and InputError for damage."""
    carriers = carrying.Carriers.of(stego)
    names = [row.tobytes() for row in carriers.names]
    for identity in carriers.salts()[:salts]:
        derived = DerivedKey(key, container.derivation_of(identity))
        records, payload = None, None
        with suppress(WrongKeyError):
            records = _records(carriers, derived)
        with suppress(WrongKeyError):
            payload = container.extract_derived(stego, derived, names)
        if records is not None:
            return records
        if payload is not None:
            return Payload("learned", payload)
    raise WrongKeyError("this key opens nothing here")


def _records(carriers: carrying.Carriers, derived: DerivedKey) -> Records:
    carrying.extract_derived(carriers, derived)  # its errors
    width = carriers.low.shape[1]
    _, opened = carrying._key_cipher(derived).open(carriers.names, carriers.low)
    data_key = Counter(map(bytes, opened)).most_common(1)[0][0]
    _, opened = carrying._parameter_cipher(data_key, width).open(carriers.names, carriers.low)
    cells, count, codec = carrying._unpack_parameters({int(part[0]): part[1:].tobytes() for part in opened})
    records = carrying._open_cells(carriers, carrying._record_cipher(data_key, codec), cells)
    copies = carrying._open_cells(carriers, carrying._copy_cipher(data_key, codec), cells)
    records = np.concatenate([records, copies[~carrying._are_among(copies, records)]])
    header = carrying._PREFIX.pack(carrying.VERSION, cells, count) + codec.pack()
    return Records("carry", header, records, np.empty(0, np.int64))
