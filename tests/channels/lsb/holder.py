"""What the holder of one key sees of a file: which rows open, and where they lie.

Not only what a reader returns: the holder of a key and of the source can look at every row.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from keyss.channels import LowBitsReader, Message, Payload, Shards
from keyss.core import Gaussians


def seen_by_holder(stego: Gaussians, key: str) -> dict[str, float]:
    """Numbers of rows of messages and shards, and how they lie in the file."""
    payload, messages, shards = _opened(stego, key)
    where = np.flatnonzero(shards)
    found = {f"rows of message {index}": float(each) for index, each in enumerate(messages)}
    found["rows with shards"] = float(shards.mean())
    found["middle of the rows with shards"] = float(where.mean() / len(stego))
    found["spread of the rows with shards"] = float(where.std() / len(stego))
    if payload.shards is not None:
        found["shards"], found["shards that there were"] = map(float, payload.shards)
    return found


def _opened(stego: Gaussians, key: str) -> tuple[Payload, list[int], npt.NDArray[np.bool_]]:
    """The payload, places of each message that hold it, and which Gaussians seem to hold shards."""
    messages: list[int] = []
    shards: list[npt.NDArray[np.bool_]] = []
    read, decrypt = Message.read, Shards.decrypt

    def read_message(self: Message, ids: Any, low: Any) -> bytes:
        data = read(self, ids, low)
        rows, contents = self.write(ids, data)
        messages.append(int((low(rows)[:, : self.width] == contents).all(axis=1).sum()))
        return data

    def decrypt_shards(self: Shards, ids: Any, low: Any) -> Any:
        found = decrypt(self, ids, low)
        shards.append(found[0])
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Message, "read", read_message)
        patch.setattr(Shards, "decrypt", decrypt_shards)
        payload = LowBitsReader.of(stego).open(key)
    return payload, messages[-2:], shards[-1]  # those before are of stale salts
