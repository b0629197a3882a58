"""What the holder of one key, and of the source, can count in a file beyond what a reader returns."""

from __future__ import annotations

import numpy as np

from keyss.channels import (
    LEAST,
    Layout,
    LowBitsReader,
    Message,
    Parameters,
    Shards,
    gaussian_ids,
    read_low_bits,
)
from keyss.channels.container import key_secret
from keyss.channels.lsb.low_bits_capacity import codewords_of, key_message, parameter_message
from keyss.channels.lsb.shards import is_tagged
from keyss.core import Gaussians
from keyss.core.arrays import Bytes
from keyss.keys import DerivedKey


def seen_by_holder(stego: Gaussians, key: str) -> dict[str, float]:
    """Numbers of rows of messages and shards, how they lie in the file, and the other low bits."""
    layout, salts = Layout.of(stego), LowBitsReader.of(stego).salts
    ids, low = gaussian_ids(stego, layout), read_low_bits(stego, LEAST, layout)
    for salt in salts:
        message = key_message(key_secret(DerivedKey.of(key, salt)), low.shape[1])
        data_key, key_rows = _read(message, ids, low)
        packed, parameter_rows = _read(parameter_message(data_key, low.shape[1]), ids, low)
        if (parameters := Parameters.unpack(packed, data_key)) is not None:  # else the salt is stale
            break
    codewords, rows = codewords_of(parameters, layout), read_low_bits(stego, parameters.depth, layout)
    own, numbers, _ = Shards(data_key, codewords, is_tagged(rows.shape[1])).decrypt(ids, rows)
    where = np.flatnonzero(own)
    return {
        "rows of the data key": float(key_rows),
        "rows of the parameters": float(parameter_rows),
        "rows with shards": float(own.mean()),
        "middle of the rows with shards": float(where.mean() / len(stego)),
        "spread of the rows with shards": float(where.std() / len(stego)),
        "gaps between rows with shards": float(np.diff(where).var()),
        "next rows with shards": float((own[1:] & own[:-1]).sum()),
        "mean of the other low bits": float(low[~own].mean()),
        "shards": float(len(np.unique(numbers))),
        "shards that there were": float(codewords.shards),
    }


def _read(message: Message, ids: Bytes, low: Bytes) -> tuple[bytes, int]:
    """The data of a message, and the number of its places that hold them."""
    data = message.read(ids, low.__getitem__)
    rows, contents = message.write(ids, data)
    return data, int((low[rows, : message.width] == contents).all(axis=1).sum())
